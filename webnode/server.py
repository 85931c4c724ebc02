"""Serve Flask (page and JSON) and native resources (streams and files) on one port with one ``Site``.

The only module of this package with side effects: it opens a port and starts a pool of worker threads.
"""

from __future__ import annotations

import errno
import gzip
import hashlib
import json
import mimetypes
import re
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from twisted.application.service import Service
from twisted.internet.defer import Deferred, gatherResults, maybeDeferred
from twisted.internet.error import CannotListenError
from twisted.internet.interfaces import IListeningPort
from twisted.internet.threads import deferToThreadPool
from twisted.python.failure import Failure
from twisted.python.threadpool import ThreadPool
from twisted.web.http import CACHED, Request
from twisted.web.resource import IResource, Resource
from twisted.web.server import Request as SiteRequest
from twisted.web.server import Site
from twisted.web.wsgi import WSGIResource

from webnode.app import OnReactor, create_app
from webnode.auth import Role
from webnode.channel import LimitedRequest, limit_connections
from webnode.errors import PortTaken, Refusal
from webnode.failover import make_urls
from webnode.live import CameraImages, EventStreams, read_token
from webnode.request_guard import find_refusal, make_headers
from webnode.resource import JsonResource, RefusedResource
from webnode.route import check_role
from webnode.routes.registry import TABLE
from webnode.services import Services
from webnode.state import State

WORKERS = 4
CALL_LIMIT_S = 2.0
STATIC = Path(__file__).parent / "static"

OpenPort = Callable[[Site], IListeningPort]
"""Opens a port for a site; raises ``PortTaken``."""


def make_caller(reactor: Any, usual_s: float = CALL_LIMIT_S) -> OnReactor:
    """Return the function with which Flask's workers call code on the reactor's thread.

    It waits at most ``limit_s`` (default ``usual_s``) for the result, also of a Deferred.  After that it raises a
    ``Refusal`` with status 503; the call may still succeed.
    """

    def on_reactor(call: Callable[..., Any], *arguments: Any, limit_s: float | None = None) -> Any:
        answers: SimpleQueue[Any] = SimpleQueue()
        reactor.callFromThread(lambda: maybeDeferred(call, *arguments).addBoth(answers.put))
        try:
            outcome = answers.get(timeout=usual_s if limit_s is None else limit_s)
        except Empty:
            raise Refusal("node", "the node did not answer in time", "check the state, then try again", 503) from None
        if isinstance(outcome, Failure):
            outcome.raiseException()
        return outcome

    return on_reactor


class StaticFiles(JsonResource):
    """``/static``: the files of the page, read and compressed once, revalidated by ETag.

    ``files.json`` lists all paths, for the service worker.
    """

    def __init__(self, folder: Path = STATIC) -> None:
        super().__init__()
        paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
        folders: dict[Path, Resource] = {folder: self}
        for path in paths:
            if path.parent not in folders:
                folders[path.parent] = JsonResource()
                folders[path.parent.parent].putChild(path.parent.name.encode(), folders[path.parent])
            folders[path.parent].putChild(path.name.encode(), _StaticFile(path.name, read_static(path)))
        listed = json.dumps([f"/static/{path.relative_to(folder).as_posix()}" for path in paths]).encode()
        self.putChild(b"files.json", _StaticFile("files.json", listed))


class _StaticFile(JsonResource):
    isLeaf = True
    methods = (b"GET", b"HEAD")

    def __init__(self, name: str, content: bytes) -> None:
        super().__init__()
        # mtime=0 makes the compressed bytes, and so the tag, equal at every node.
        packed = gzip.compress(content, 9, mtime=0)
        self._encodings = {"": content, "gzip": packed} if len(packed) < len(content) else {"": content}
        self._tag = hashlib.blake2s(content, digest_size=8).hexdigest()
        kind = mimetypes.guess_type(name)[0] or "application/octet-stream"
        self._kind = kind + ("; charset=utf-8" if kind.startswith("text/") else "")

    def render_GET(self, request: Request) -> bytes:
        encoding = (
            "gzip" if "gzip" in self._encodings and _accepts_gzip(request.getHeader("accept-encoding") or "") else ""
        )
        request.setHeader("Content-Type", self._kind)
        request.setHeader("Cache-Control", "no-cache")
        request.setHeader("Vary", "Accept-Encoding")
        if request.setETag(f'"{self._tag}{encoding}"'.encode()) is CACHED:
            return b""
        if encoding:
            request.setHeader("Content-Encoding", encoding)
        return self._encodings[encoding]


def read_static(path: Path) -> bytes:
    """Return the content to send; comment lines of scripts become empty lines, which keeps line numbers."""
    content = path.read_bytes()
    return re.sub(rb"^ *//.*$", b"", content, flags=re.MULTILINE) if path.suffix == ".js" else content


def _accepts_gzip(accepted: str) -> bool:
    """Return whether an ``Accept-Encoding`` header accepts gzip with a weight above zero."""
    for entry in accepted.split(","):
        name, _, weight = entry.replace(" ", "").partition(";q=")
        if name == "gzip":
            return weight.strip("0.") != "" or not weight
    return False


class Root(Resource):
    """Dispatch a request to the native resource of its path, or to Flask.

    Access to native resources is checked here, as Flask checks its own routes.
    """

    def __init__(
        self,
        flask: IResource,
        native: dict[str, Resource],
        services: Services,
        wall: Callable[[], float],
        hosts: Collection[str] = (),
    ) -> None:
        super().__init__()
        self._flask = flask
        self._native = [
            (tuple(path.strip("/").encode().split(b"/")), resource, _get_role(path))
            for path, resource in sorted(native.items(), key=lambda item: -item[0].count("/"))
        ]
        self._services = services
        self._wall = wall
        self._hosts = hosts

    def getChild(self, path: bytes, request: SiteRequest) -> IResource:
        """Return the resource for ``path``."""
        assert request.prepath is not None and request.postpath is not None
        segments = (path, *request.postpath)
        for pattern, resource, role in self._native:
            if _is_match(segments, pattern):
                for _ in pattern[1:]:
                    request.prepath.append(request.postpath.pop(0))
                return self._check_role(resource, role, request)
        request.prepath.pop()
        request.postpath.insert(0, path)
        return self._flask

    def _check_role(self, resource: Resource, role: Role, request: SiteRequest) -> IResource:
        host, origin = request.getHeader("host") or "", request.getHeader("origin")
        is_allowed_origin = self._services.fallbacks.is_allowed_origin
        for name, value in make_headers(host, origin, is_allowed_origin).items():
            request.setHeader(name, value)
        method = (request.method or b"").decode("ascii", "replace")
        # navigator.sendBeacon, which a phone uses when its page is closed, cannot set headers.
        has_csrf_header = role == "phone" or request.getHeader("x-swarm") == "1" or method == "GET"
        problem = find_refusal(method, host, origin, has_csrf_header, self._hosts, is_allowed_origin)
        if problem is not None:
            return RefusedResource(problem)
        if method == "OPTIONS":
            return _Preflight()
        try:
            user = self._services.sessions.authenticate(read_token(request), self._wall())
            check_role(role, user)
        except Refusal as refusal:
            return RefusedResource(refusal)
        if isinstance(request, LimitedRequest):
            request.authenticated_user = user
        return resource


class _Preflight(Resource):
    """The answer to a CORS preflight request."""

    isLeaf = True

    def render(self, request: Request) -> bytes:
        request.setResponseCode(204)
        return b""


def _is_match(segments: Sequence[bytes], pattern: Sequence[bytes]) -> bool:
    return len(segments) >= len(pattern) and all(
        segment == wanted or (wanted.startswith(b"{") and segment != b"")
        for segment, wanted in zip(segments, pattern, strict=False)
    )


def _get_role(path: str) -> Role:
    """Return the role for the native route at ``path`` or below it; "operator" for a path without a route."""
    roles = [route.role for route in TABLE if route.handler is None and f"{route.path}/".startswith(f"{path}/")]
    return roles[0] if roles else "operator"


def open_port(reactor: Any, host: str, port: int, factory: Any, setting: str) -> IListeningPort:
    """Open a TCP port for ``factory``; raises ``PortTaken``, with a remedy for ``setting``."""
    try:
        opened: IListeningPort = reactor.listenTCP(port, factory, interface=host)
    except CannotListenError as error:
        why = getattr(error.socketError, "strerror", None) or str(error.socketError)
        is_foreign = getattr(error.socketError, "errno", None) == errno.EADDRNOTAVAIL
        remedy = "set host to an address of this machine" if is_foreign else f"choose another {setting}, or 0 for any"
        raise PortTaken(f"cannot serve the page on {host or '*'}:{port} ({why}); {remedy}") from error
    return opened


class QuietSite(Site):
    """A site without an access log (three cameras would write forty lines a second) and without a Server header."""

    def getResourceFor(self, request: Any) -> IResource:  # noqa: N802
        """Return the resource for the request, and remove the Server header."""
        request.responseHeaders.removeHeader(b"server")
        found: IResource = super().getResourceFor(request)
        return found

    def log(self, request: Request) -> None:
        """Write nothing."""


class WebService(Service):
    """The page as a service of the node's process.

    ``startService`` raises ``PortTaken`` (one line for the operator) if the port is not available; with port 0 the
    property ``port`` has the chosen one.  ``read`` returns the newest state on any thread, ``live`` on the reactor's
    thread (default: ``read``); ``version`` can avoid reading it again (see ``EventStreams``).  ``wall`` returns unix
    time in seconds.  ``port_openers`` open further ports for the same page.
    """

    name = "web"

    def __init__(
        self,
        reactor: Any,
        host: str,
        port: int,
        read: Callable[[], State],
        services: Services,
        wall: Callable[[], float],
        hosts: Collection[str] = (),
        port_openers: Sequence[OpenPort] = (),
        live: Callable[[], State] | None = None,
        version: Callable[[], object] | None = None,
    ) -> None:
        self._reactor = reactor
        self._host = host
        self._configured_port = port
        self._port_openers = port_openers
        self._pool = ThreadPool(1, WORKERS, "web")
        flask = WSGIResource(reactor, self._pool, create_app(read, services, make_caller(reactor), hosts, wall))
        self._events = EventStreams(live or read, reactor, wall, services, version)
        self._camera_images = CameraImages(services.control.stream_camera, reactor)
        native: dict[str, Resource] = {"/events": self._events, "/shot": self._camera_images, "/static": StaticFiles()}
        native.update({route.path: route.native(services, reactor) for route in TABLE if route.native is not None})
        root = Root(flask, native, services, wall, hosts)
        self.site = QuietSite(root, requestFactory=LimitedRequest, timeout=30)
        self.site.displayTracebacks = False
        limit_connections(self.site, services.limits)
        self._listening: IListeningPort | None = None
        self._secure_ports: list[IListeningPort] = []

    @property
    def port(self) -> int:
        """The port of the page; the configured one before the service starts."""
        return (
            self._configured_port
            if self._listening is None
            else int(getattr(self._listening.getHost(), "port", self._configured_port))
        )

    @property
    def secure_port(self) -> int:
        """The first of the further ports; 0 if there is none or the service has not started."""
        return next((int(getattr(opener.getHost(), "port", 0)) for opener in self._secure_ports), 0)

    def urls(self, names: Collection[str]) -> list[str]:
        """Return the URLs of the page; ``names`` are this machine's, for a page at all addresses."""
        port_openers = make_urls(self._host, self.secure_port, names, is_secure=True) if self.secure_port else []
        return [*make_urls(self._host, self.port, names), *port_openers]

    def startService(self) -> None:
        """Open the ports, then start the workers."""
        self._listening = open_port(self._reactor, self._host, self._configured_port, self.site, "port")
        try:
            for opener in self._port_openers:
                self._secure_ports.append(opener(self.site))
        except PortTaken:
            for port in (self._listening, *self._secure_ports):
                port.stopListening()
            self._listening, self._secure_ports = None, []
            raise
        self._pool.start()
        self._events.start()
        super().startService()

    def stopService(self) -> Deferred[None] | None:
        """Close the ports and all streams, and stop the workers."""
        super().stopService()
        if self._listening is None:
            return None
        closed: list[Deferred[Any]] = [
            maybeDeferred(port.stopListening) for port in (self._listening, *self._secure_ports)
        ]
        self._listening, self._secure_ports = None, []
        self._events.close()
        self._camera_images.close()
        # Runs on another thread, because a worker may be waiting for the reactor.
        closed.append(deferToThreadPool(self._reactor, self._reactor.getThreadPool(), self._pool.stop))
        return gatherResults(closed).addCallback(lambda _: None)
