"""Tests of ``webnode.server``."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from twisted.internet.defer import Deferred, succeed
from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase
from twisted.web.resource import Resource
from twisted.web.static import Data

from tests.webnode.browser import Connection, site_of
from tests.webnode.guests import Guests
from tests.webnode.memory import MemoryTeamControl
from webnode.auth import OpenSessions
from webnode.errors import Refusal
from webnode.failover import Fallbacks, Page
from webnode.request_guard import MAX_BODY
from webnode.resource import JsonResource
from webnode.server import Root, StaticFiles, make_caller, read_static
from webnode.services import Services


class PathResource(Resource):
    isLeaf = True

    def render(self, request: Any) -> bytes:
        return b"flask " + b"/".join(request.postpath) + b" %d" % len(request.content.read())


class Stream(JsonResource):
    isLeaf = True

    def render_GET(self, request: Any) -> bytes:
        return b"native"


NATIVE: dict[str, Resource] = {"/stream": Stream()}


class ReadStaticTests(SynchronousTestCase):
    def test_send_no_comments(self) -> None:
        """Scripts are sent without full-line comments; line numbers and strings are unchanged."""
        script = Path(self.mktemp()).with_suffix(".js")
        script.write_text("// About it.\nconst a = 1; // one\n  // More.\nexport const URL = `http://a`;\n")
        self.assertEqual(read_static(script), b"\nconst a = 1; // one\n\nexport const URL = `http://a`;\n")


class RootTests(SynchronousTestCase):
    def setUp(self) -> None:
        native: dict[str, Resource] = {"/events": Data(b"native", "text/plain"), "/static": StaticFiles()}
        self.services = Services(MemoryTeamControl(), OpenSessions())
        self.site = site_of(Root(PathResource(), native, self.services, lambda: 1e9), Clock())

    def asked(self, path: str, method: str = "GET", **headers: str) -> bytes:
        return Connection(self.site).ask(path, method, **headers).taken()

    def test_divide(self) -> None:
        """Streams and files are native routes; Flask serves all other paths."""
        self.assertIn(b"native", self.asked("/events"))
        self.assertIn(b"flask api/v1/state 0", self.asked("/api/v1/state"))
        self.assertIn(b"flask  0", self.asked("/"))

    def test_tell_all_files(self) -> None:
        """A browser that stores the page receives the list of its files, and each file exists."""
        paths = json.loads(self.asked("/static/files.json").partition(b"\r\n\r\n")[2])
        self.assertLess({"/static/page.js", "/static/sw.js", "/static/base.css", "/static/texts/en.js"}, set(paths))
        for path in paths:
            self.assertIn(b" 200 ", self.asked(path)[:15], path)

    def test_refuse_in_json(self) -> None:
        """Errors of native routes are JSON with the strict headers, and do not contain the server's version."""
        self.site = site_of(
            Root(PathResource(), {**NATIVE, "/static": StaticFiles()}, self.services, lambda: 1e9), Clock()
        )
        asked = [
            ("/static/nothing.js", "GET", 404),
            ("/static/../app.py", "GET", 404),
            ("/static/", "GET", 404),
            ("/static", "GET", 404),
            ("/static/page.js/more", "GET", 404),
            ("/static/page.js", "POST", 405),
            ("/stream", "POST", 405),
            ("/stream", "PUT", 405),
            ("/stream", "HEAD", 405),
            ("/stream", "BREW", 405),
            ("/stream/more", "GET", 404),
        ]
        for path, method, status in asked:
            data = self.asked(path, method, X_Swarm="1")
            self.assertTrue(data.startswith(f"HTTP/1.1 {status} ".encode()), (path, method, data))
            self.assertIn(b"Content-Type: application/json", data)
            self.assertIn(b"frame-ancestors 'none'", data)
            self.assertNotIn(b"Server:", data)
            if method != "HEAD":
                self.assertIn(b'{"error": {"field"', data)
            if status == 405:
                self.assertIn(b"Allow: GET", data)

    def test_ask_for_the_role(self) -> None:
        """A native route checks the role by header or ticket; its error does not contain an invalid ticket."""
        self.services.sessions = Guests()
        self.assertIn(b" 401 ", self.asked("/events"))
        self.assertIn(b" 401 ", self.asked("/events?ticket=nonsense"))
        self.assertNotIn(b"nonsense", self.asked("/events?ticket=nonsense"))
        self.assertIn(b"native", self.asked("/events", Authorization="Bearer phone"))
        self.assertIn(b"native", self.asked("/events?ticket=viewer"))
        self.assertIn(b"native", self.asked("/events", Authorization="Bearer operator"))
        self.assertIn(b" 200 ", self.asked("/static/page.js"))

    def test_find_deep_routes(self) -> None:
        """A native route can be below the API: its whole path must match, and the role is checked."""
        native: dict[str, Resource] = {"/api/v1/phones/{uuid}/look": Data(b"seen", "text/plain")}
        self.site = site_of(Root(PathResource(), native, self.services, lambda: 1e9), Clock())
        self.assertIn(b"seen", self.asked("/api/v1/phones/01/look"))
        for path in ("/api/v1/phones/01", "/api/v1/phones/01/leave", "/api/v1/phones//look"):
            self.assertIn(b"flask " + path[1:].encode(), self.asked(path))
        self.services.sessions = Guests()
        self.assertIn(b" 403 ", self.asked("/api/v1/phones/01/look?ticket=viewer"))

    def test_share_with_the_team(self) -> None:
        """A page of another web node of the team may send requests, also after a preflight; other origins may not."""
        self.services.fallbacks = Fallbacks(Page("02", "http://other:8080"))
        for method in ("GET", "OPTIONS"):
            data = self.asked("/events", method, Origin="http://other:8080")
            self.assertIn(b"Access-Control-Allow-Origin: http://other:8080", data)
            self.assertNotIn(b"Access-Control", self.asked("/events", method, Origin="http://evil:8080"))
        self.assertIn(b" 403 ", self.asked("/events", "OPTIONS", Origin="http://evil:8080"))

    def test_pack_files(self) -> None:
        """A file is compressed if the client accepts gzip; each variant has its own ETag."""
        plain = self.asked("/static/page.js")
        packed = self.asked("/static/page.js", Accept_Encoding="br, gzip;q=0.8")
        self.assertIn(b"Content-Encoding: gzip", packed)
        self.assertEqual(gzip.decompress(packed.split(b"\r\n\r\n", 1)[1]), plain.split(b"\r\n\r\n", 1)[1])
        tags = {data.lower().split(b"etag: ")[1].split(b"\r\n")[0] for data in (plain, packed)}
        self.assertEqual(len(tags), 2)
        for refused in ("gzip;q=0", "br", "gzip;q=0.000"):
            self.assertNotIn(b"Content-Encoding", self.asked("/static/page.js", Accept_Encoding=refused))

    def test_serve_files(self) -> None:
        """A file is revalidated by ETag at each visit; a missing file gives status 404."""
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
        """A body of exactly the maximum size is accepted."""
        body = bytes(MAX_BODY)
        head = f"POST /api/x HTTP/1.1\r\nHost: vaio\r\nContent-Length: {len(body)}\r\n\r\n".encode()
        self.assertIn(b"flask api/x %d" % MAX_BODY, Connection(self.site).send(head + body).taken())

    def test_cut_large_bodies(self) -> None:
        """A too large body is rejected because of its declared length, or as soon as it exceeds the limit."""
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
        """The caller receives the result of the call, also from a Deferred; a ``Refusal`` is raised in the caller."""

        def refuse() -> None:
            raise Refusal("name", "no", "ask another", 404)

        on_reactor = make_caller(QuickReactor())
        self.assertEqual(on_reactor(lambda a, b: a + b, 1, 2), 3)
        self.assertEqual(on_reactor(lambda: succeed("t1")), "t1")
        self.assertEqual(self.assertRaises(Refusal, on_reactor, refuse).status, 404)

    def test_wait_no_longer_than_the_limit(self) -> None:
        """If a call does not return within the limit, the response is 503."""
        never: Deferred[None] = Deferred()
        for usual_s, given in ((0.0, {}), (1e6, {"limit_s": 0.0})):
            error = self.assertRaises(Refusal, make_caller(QuickReactor(), usual_s), lambda: never, **given)
            self.assertEqual(error.status, 503)
