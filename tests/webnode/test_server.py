"""What ``webnode.server`` promises."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred, succeed
from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase
from twisted.web.resource import Resource
from twisted.web.static import Data

from tests.webnode.browser import Connection, site_of
from webnode.errors import Refusal
from webnode.guard import MAX_BODY
from webnode.server import Files, Root, caller


class PathResource(Resource):
    isLeaf = True

    def render(self, request: Any) -> bytes:
        return b"flask " + b"/".join(request.postpath) + b" %d" % len(request.content.read())


class RootTests(SynchronousTestCase):
    def setUp(self) -> None:
        native: dict[bytes, Resource] = {b"events": Data(b"native", "text/plain"), b"static": Files()}
        self.site = site_of(Root(PathResource(), native), Clock())

    def asked(self, path: str, **headers: str) -> bytes:
        return Connection(self.site).ask(path, **headers).taken()

    def test_divide(self) -> None:
        """Streams and files are native; everything else, the root included, is Flask's with its whole path."""
        self.assertIn(b"native", self.asked("/events"))
        self.assertIn(b"flask api/state 0", self.asked("/api/state"))
        self.assertIn(b"flask  0", self.asked("/"))

    def test_be_strict(self) -> None:
        """Native answers carry the strict headers too, and are for this node's own names only."""
        data = self.asked("/events")
        self.assertIn(b"default-src 'self'", data)
        self.assertIn(b"nosniff", data)
        self.assertIn(b" 403 ", self.asked("/events", Host="evil.example"))

    def test_serve_files(self) -> None:
        """A file is revalidated at each visit and not sent twice; what is not there is not found."""
        data = self.asked("/static/page.js")
        self.assertIn(b"text/javascript", data)
        self.assertIn(b"Cache-Control: no-cache", data)
        etag = data.lower().split(b"etag: ")[1].split(b"\r\n")[0].decode()
        again = self.asked("/static/page.js", If_None_Match=etag)
        self.assertIn(b" 304 ", again)
        self.assertNotIn(b"import", again)
        for path in ("/static/nothing.js", "/static/..%2fapp.py", "/static/../app.py"):
            self.assertNotIn(b"create_app", self.asked(path))

    def test_take_small_bodies(self) -> None:
        """A body of the largest lawful size comes through."""
        body = bytes(MAX_BODY)
        head = f"POST /api/x HTTP/1.1\r\nHost: vaio\r\nContent-Length: {len(body)}\r\n\r\n".encode()
        self.assertIn(b"flask api/x %d" % MAX_BODY, Connection(self.site).send(head + body).taken())

    def test_cut_large_bodies(self) -> None:
        """A body announced as too large is refused before it comes; one that only grows is cut at the limit."""
        announced = Connection(self.site).send(b"POST /api/x HTTP/1.1\r\nHost: vaio\r\nContent-Length: 65537\r\n\r\n")
        growing = Connection(self.site).send(
            b"POST /api/x HTTP/1.1\r\nHost: vaio\r\nTransfer-Encoding: chunked\r\n\r\n"
        )
        for _ in range(65):
            growing.send(b"400\r\n" + bytes(1024) + b"\r\n")
        growing.send(b"0\r\n\r\n")
        for connection in (announced, growing):
            data = connection.taken()
            self.assertEqual(data.count(b"HTTP/1.1"), 1)
            self.assertTrue(data.startswith(b"HTTP/1.1 413 "))
            self.assertTrue(connection.transport.disconnecting)


class QuickReactor:
    def callFromThread(self, call: Callable[[], Any]) -> None:  # noqa: N802
        call()


class CallerTests(SynchronousTestCase):
    def test_bring_the_answer(self) -> None:
        """What the desk returns comes back, also by a Deferred; what it refuses is raised."""

        def refuse() -> None:
            raise Refusal("name", "no", "ask another", 404)

        on_reactor = caller(QuickReactor())
        self.assertEqual(on_reactor(lambda a, b: a + b, 1, 2), 3)
        self.assertEqual(on_reactor(lambda: succeed("t1")), "t1")
        self.assertEqual(self.assertRaises(Refusal, on_reactor, refuse).status, 404)

    def test_wait_no_longer_than_the_limit(self) -> None:
        """A desk that does not answer costs the worker only the limit, and the visitor is told to look."""
        never: Deferred[None] = Deferred()
        error = self.assertRaises(Refusal, caller(QuickReactor(), 0.0), lambda: never)
        self.assertEqual(error.status, 503)
