"""The web node's one port: Flask for the page and JSON, native resources for the streams and files, in one ``Site``.

The only module of this room that touches the world: a listening port and a pool of worker threads.
"""

from __future__ import annotations

import errno
import hashlib
import mimetypes
from collections.abc import Callable, Collection
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from flask import Flask
from twisted.application.service import Service
from twisted.internet.defer import Deferred, maybeDeferred
from twisted.internet.error import CannotListenError
from twisted.internet.interfaces import IListeningPort
from twisted.python.failure import Failure
from twisted.python.threadpool import ThreadPool
from twisted.web.http import CACHED, Request
from twisted.web.resource import IResource, Resource
from twisted.web.server import Request as SiteRequest
from twisted.web.server import Site
from twisted.web.wsgi import WSGIResource

from webnode.app import OnReactor, create_app
from webnode.camera import FrameSource
from webnode.desk import Desk
from webnode.errors import PortTaken, Refusal
from webnode.guard import HEADERS, MAX_BODY, is_local_host
from webnode.live import Events, Shots, answer
from webnode.state import State

WORKERS = 4
LIMIT_S = 2.0
STATIC = Path(__file__).parent / "static"


def caller(reactor: Any, limit_s: float = LIMIT_S) -> OnReactor:
    """What Flask's workers call the desk with: run on the reactor's thread, wait at most ``limit_s`` for the answer.

    A Deferred is waited for.  Where no answer comes in time a ``Refusal`` with status 503 is raised; the wish may still
    be granted.
    """

    def on_reactor(wish: Callable[..., Any], *arguments: Any) -> Any:
        answers: SimpleQueue[Any] = SimpleQueue()
        reactor.callFromThread(lambda: maybeDeferred(wish, *arguments).addBoth(answers.put))
        try:
            outcome = answers.get(timeout=limit_s)
        except Empty:
            raise Refusal("node", "it did not answer in time", "look at the state, then try again", 503) from None
        if isinstance(outcome, Failure):
            outcome.raiseException()
        return outcome

    return on_reactor


class Files(Resource):
    """``/static``: the page's few files, read once; revalidated by ETag at every visit, so an update shows at once."""

    def __init__(self, folder: Path = STATIC) -> None:
        super().__init__()
        for path in sorted(folder.iterdir()):
            if path.is_file():
                self.putChild(path.name.encode(), _File(path))


class _File(Resource):
    isLeaf = True

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._content = path.read_bytes()
        self._etag = b'"' + hashlib.blake2s(self._content, digest_size=8).hexdigest().encode() + b'"'
        kind = mimetypes.guess_type(path.name)[0] or "application/octet-stream"
        self._kind = kind + ("; charset=utf-8" if kind.startswith("text/") else "")

    def render_GET(self, request: Request) -> bytes:
        request.setHeader("Content-Type", self._kind)
        request.setHeader("Cache-Control", "no-cache")
        if request.setETag(self._etag) is CACHED:
            return b""
        return self._content


class _Missing(Resource):
    isLeaf = True

    def __init__(self, refusal: Refusal) -> None:
        super().__init__()
        self._refusal = refusal

    def render(self, request: Request) -> bytes:
        return answer(request, self._refusal)


class Root(Resource):
    """Who answers what: the native resources by their first word, Flask everything else."""

    def __init__(self, flask: IResource, native: dict[bytes, Resource], hosts: Collection[str] = ()) -> None:
        super().__init__()
        self._flask = flask
        self._native = native
        self._hosts = hosts

    def getChild(self, path: bytes, request: SiteRequest) -> IResource:
        """The resource for ``path``."""
        child = self._native.get(path)
        if child is None:
            assert request.prepath is not None and request.postpath is not None
            request.prepath.pop()
            request.postpath.insert(0, path)
            return self._flask
        if not is_local_host((request.getHeader("host") or ""), self._hosts):
            return _Missing(Refusal("Host", "this name is not one of the node's", "use its address", 403))
        for name, value in HEADERS.items():
            request.setHeader(name, value)
        return child


class CappedRequest(SiteRequest):
    """A request whose body is never kept beyond ``guard.MAX_BODY``: answered with 413 and cut off."""

    _taken = 0
    _cut = False

    def gotLength(self, length: int | None) -> None:  # noqa: N802
        """Refuse a body that announces itself as too large."""
        super().gotLength(0 if length is not None and length > MAX_BODY else length)
        if length is not None and length > MAX_BODY:
            self._refuse()

    def handleContentChunk(self, data: bytes) -> None:  # noqa: N802
        """Take a piece of the body, or refuse the rest."""
        self._taken += len(data)
        if self._taken > MAX_BODY:
            self._refuse()
        if not self._cut:
            super().handleContentChunk(data)

    def requestReceived(self, command: bytes, path: bytes, version: bytes) -> None:  # noqa: N802
        """Go on, unless the body was refused."""
        if not self._cut:
            super().requestReceived(command, path, version)

    def _refuse(self) -> None:
        if self._cut or self.channel is None:
            return
        self._cut = True
        body = b'{"error": {"field": "body", "problem": "it is too large", "remedy": "send at most 64 KiB"}}'
        head = b"HTTP/1.1 413 Content Too Large\r\nContent-Type: application/json\r\nConnection: close\r\n"
        transport = self.channel.transport
        assert transport is not None
        transport.write(head + b"Content-Length: %d\r\n\r\n" % len(body) + body)
        transport.loseConnection()


class QuietSite(Site):
    """A site that keeps no access log: three cameras alone would write forty lines a second."""

    def log(self, request: Request) -> None:
        """Write nothing."""


class WebService(Service):
    """The page as a service of the node's process.

    ``startService`` raises ``PortTaken`` (one line for a person) where the port cannot be had; ``port`` 0 takes
    any, see ``port``.
    """

    name = "web"

    def __init__(
        self,
        reactor: Any,
        host: str,
        port: int,
        app: Flask,
        events: Events,
        shots: Shots,
        static: Resource,
        hosts: Collection[str] = (),
    ) -> None:
        self._reactor = reactor
        self._host = host
        self._wanted = port
        self._pool = ThreadPool(1, WORKERS, "web")
        flask = WSGIResource(reactor, self._pool, app)
        native: dict[bytes, Resource] = {b"events": events, b"shot": shots, b"static": static}
        self._events = events
        self._shots = shots
        self.site = QuietSite(Root(flask, native, hosts), requestFactory=CappedRequest, timeout=30)
        self.site.displayTracebacks = False
        self._listening: IListeningPort | None = None

    @property
    def port(self) -> int:
        """The port on which the page is served; the wanted one until the service runs."""
        return (
            self._wanted if self._listening is None else int(getattr(self._listening.getHost(), "port", self._wanted))
        )

    def startService(self) -> None:
        """Open the port, then the workers."""
        try:
            self._listening = self._reactor.listenTCP(self._wanted, self.site, interface=self._host)
        except CannotListenError as error:
            why = getattr(error.socketError, "strerror", None) or str(error.socketError)
            where = f"{self._host or '*'}:{self._wanted}"
            is_foreign = getattr(error.socketError, "errno", None) == errno.EADDRNOTAVAIL
            remedy = "give host an address of this machine" if is_foreign else "choose another port, or 0"
            raise PortTaken(f"the page cannot be served on {where} ({why}); {remedy}") from error
        self._pool.start()
        super().startService()

    def stopService(self) -> Deferred[None] | None:
        """Close the port and every stream, and let the workers end."""
        super().stopService()
        if self._listening is None:
            return None
        closed = maybeDeferred(self._listening.stopListening)
        self._listening = None
        self._events.close()
        self._shots.close()
        self._pool.stop()
        return closed.addCallback(lambda _: None)


def web_service(
    reactor: Any,
    host: str,
    port: int,
    read: Callable[[], State],
    desk: Desk,
    frames: FrameSource,
    wall: Callable[[], float],
    hosts: Collection[str] = (),
) -> WebService:
    """The whole web node from what the front door has; ``wall`` is the unix time in seconds."""
    app = create_app(read, desk, caller(reactor), hosts)
    return WebService(
        reactor, host, port, app, Events(read, reactor, wall, desk.yard), Shots(frames, reactor), Files(), hosts
    )
