"""One HTTP connection with deadlines and limits per address; independent of routes.

Twisted's idle timeout does not end a connection that sends a byte now and then (Slowloris).  So each part of a request
has a deadline, an address has a limit of incomplete requests, and a client that does not read its response is
disconnected.
"""

from __future__ import annotations

import json
from typing import Any

from twisted.internet.interfaces import IDelayedCall
from twisted.python.failure import Failure
from twisted.web.http import HTTPChannel
from twisted.web.server import Request as SiteRequest
from twisted.web.server import Site

from webnode.auth import User
from webnode.errors import Refusal
from webnode.limits import AddressLimits, CountedKind
from webnode.request_guard import HEADERS, MAX_BODY

HEADERS_LIMIT_S = 10.0
"""Deadline for a request's headers, after its first byte or after the connection was made."""
KEEP_ALIVE_S = 15.0
"""Time that an idle connection stays open for its next request."""
GRACE_S, PACE = 2.0, 1000.0
"""Grace period of a request body, and the minimum rate afterwards in bytes per second."""
STALL_LIMIT_S = 30.0
"""Time after which a response that the client does not read is aborted."""
CLOSE_LIMIT_S = 2.0
"""Time for a refused client to read the reason."""
STATUS = {400: "Bad Request", 408: "Request Timeout", 413: "Content Too Large", 503: "Service Unavailable"}

TOO_LARGE = Refusal("body", "the request is too large", "send at most 64 KiB", 413)
UNREADABLE = Refusal("request", "the request is not valid HTTP", "send HTTP/1.1, with at most 16 KiB of headers", 400)
LATE_HEAD = Refusal(
    "request", "the headers are not complete in time", f"send all headers within {HEADERS_LIMIT_S:g} s", 408
)
LATE_BODY = Refusal("body", "the body arrives too slowly", f"send at least {PACE:g} bytes a second", 408)
TOO_MANY = Refusal(
    "request", "there are too many incomplete requests from this address", "complete these requests first", 503
)
TOO_BUSY = Refusal(
    "request", "there are too many open requests from this address", "close some of them, then try again", 503
)


def make_raw_response(refusal: Refusal) -> bytes:
    """Return the complete HTTP response to a request that does not reach Flask."""
    body = json.dumps(refusal.fields).encode()
    lines = [f"HTTP/1.1 {refusal.status} {STATUS[refusal.status]}", "Content-Type: application/json"]
    lines += [f"{name}: {value}" for name, value in HEADERS.items()]
    lines += ["Cache-Control: no-store", "Connection: close", f"Content-Length: {len(body)}", "", ""]
    return "\r\n".join(lines).encode() + body


class LimitedRequest(SiteRequest):
    """A request with a limit for its body, ``guard.MAX_BODY``; a larger body is answered with 413 and disconnected.

    ``authenticated_user`` is the client of a request to a native resource.
    """

    authenticated_user = User()
    _body_bytes = 0
    _is_refused = False

    def gotLength(self, length: int | None) -> None:  # noqa: N802
        """Refuse a body whose Content-Length is too large."""
        super().gotLength(0 if length is not None and length > MAX_BODY else length)
        if length is not None and length > MAX_BODY:
            self._refuse()

    def handleContentChunk(self, data: bytes) -> None:  # noqa: N802
        """Take a chunk of the body, or refuse the rest."""
        self._body_bytes += len(data)
        if self._body_bytes > MAX_BODY:
            self._refuse()
        if not self._is_refused:
            super().handleContentChunk(data)

    def requestReceived(self, command: bytes, path: bytes, version: bytes) -> None:  # noqa: N802
        """Process the request, unless its body was refused."""
        if not self._is_refused:
            super().requestReceived(command, path, version)

    def _refuse(self) -> None:
        if self._is_refused or self.channel is None:
            return
        self._is_refused = True
        channel: Any = self.channel
        if isinstance(channel, Channel):
            channel.refuse(TOO_LARGE)
        else:
            channel.transport.write(make_raw_response(TOO_LARGE))
            channel.transport.loseConnection()


class Channel(HTTPChannel):
    """A connection with deadlines; ``factory`` is a site that was passed to ``limit_connections``."""

    factory: Any
    transport: Any
    limits: AddressLimits
    _phase = "idle"
    _deadline: IDelayedCall | None = None
    _stall_deadline: IDelayedCall | None = None
    _counted_kind: CountedKind | None = None
    _open = False
    _is_over = False
    _received_bytes = 0
    _since = 0.0

    def connectionMade(self) -> None:  # noqa: N802
        """Wait for a request; abort if the address has too many connections."""
        super().connectionMade()
        self.limits = self.factory.limits
        self._address = str(getattr(self.getPeer(), "host", ""))
        if not self.limits.can_open("open", self._address):
            self._is_over = True
            self.transport.abortConnection()
            return
        self.limits.count("open", self._address, 1)
        self._open = True
        self._set_deadline(HEADERS_LIMIT_S, self._close)

    def dataReceived(self, data: bytes) -> None:  # noqa: N802
        """Take bytes and update the request's phase."""
        if self._is_over:
            return
        if self._phase == "idle":
            self._start_request()
        self._received_bytes += len(data)
        super().dataReceived(data)
        self._count_incomplete()

    def allHeadersReceived(self) -> None:  # noqa: N802
        """Start the deadline of the body."""
        if self._is_over:
            return
        self._phase, self._since = "body", self._now()
        self._set_deadline(GRACE_S, self._check_pace)
        super().allHeadersReceived()

    def allContentReceived(self) -> None:  # noqa: N802
        """End the deadline, and count the request as being answered."""
        if self._is_over:
            return
        self._phase = "answer"
        self._cancel(self._deadline)
        self._deadline = None
        if not self.limits.can_open("stream", self._address):
            self.refuse(TOO_BUSY)
            return
        self._count("stream")
        super().allContentReceived()

    def requestDone(self, request: Any) -> None:  # noqa: N802
        """Wait for the next request, of which bytes may have arrived already."""
        self._count(None)
        self._phase = "idle"
        waits = bool(self._dataBuffer)
        self._set_deadline(KEEP_ALIVE_S, self._close)
        if waits:
            self._start_request()
        super().requestDone(request)
        self._count_incomplete()

    def pauseProducing(self) -> None:  # noqa: N802
        """Start the deadline for a client that does not read its response."""
        super().pauseProducing()
        if self._stall_deadline is None and not self._is_over:
            self._stall_deadline = self.callLater(STALL_LIMIT_S, self._abort)

    def resumeProducing(self) -> None:  # noqa: N802
        """End the deadline for the client to read."""
        super().resumeProducing()
        self._cancel(self._stall_deadline)
        self._stall_deadline = None

    def connectionLost(self, reason: Failure) -> None:  # type: ignore[override]  # noqa: N802
        """Cancel all deadlines and counts."""
        self._is_over = True
        self._count(None)
        if self._open:
            self.limits.count("open", self._address, -1)
            self._open = False
        for each in (self._deadline, self._stall_deadline):
            self._cancel(each)
        self._deadline = self._stall_deadline = None
        super().connectionLost(reason)

    def refuse(self, refusal: Refusal) -> None:
        """Answer an invalid or incomplete request, and end the connection."""
        if self._is_over:
            return
        self._is_over = True
        self._count(None)
        self.transport.write(make_raw_response(refusal))
        self.loseConnection()
        self._set_deadline(CLOSE_LIMIT_S, self._abort)

    def lineLengthExceeded(self, line: bytes) -> None:  # noqa: N802
        """Refuse a line that exceeds the limit for all headers."""
        self.refuse(UNREADABLE)

    def _respondToBadRequestAndDisconnect(self) -> None:  # noqa: N802
        # Twisted's method sends neither a body nor the security headers.
        self.refuse(UNREADABLE)

    def _start_request(self) -> None:
        self._phase, self._received_bytes = "head", 0
        self._set_deadline(HEADERS_LIMIT_S, lambda: self.refuse(LATE_HEAD))

    def _count_incomplete(self) -> None:
        """Count a request that is not complete; a request that arrives whole is not counted."""
        if self._is_over or self._phase not in ("head", "body") or self._counted_kind:
            return
        if not self.limits.can_open("unfinished", self._address):
            self.refuse(TOO_MANY)
            return
        self._count("unfinished")

    def _check_pace(self) -> None:
        if self._received_bytes < PACE * (self._now() - self._since - GRACE_S):
            self.refuse(LATE_BODY)
        else:
            self._set_deadline(1.0, self._check_pace)

    def _count(self, kind: CountedKind | None) -> None:
        if self._counted_kind != kind:
            if self._counted_kind:
                self.limits.count(self._counted_kind, self._address, -1)
            if kind:
                self.limits.count(kind, self._address, 1)
            self._counted_kind = kind

    def _set_deadline(self, seconds: float, on_timeout: Any) -> None:
        self._cancel(self._deadline)
        self._deadline = self.callLater(seconds, on_timeout)

    def _cancel(self, call: IDelayedCall | None) -> None:
        if call is not None and call.active():
            call.cancel()

    def _now(self) -> float:
        return float(self.factory.reactor.seconds())

    def _close(self) -> None:
        self._is_over = True
        self.loseConnection()
        self._set_deadline(CLOSE_LIMIT_S, self._abort)

    def _abort(self) -> None:
        self._is_over = True
        self.transport.abortConnection()


def limit_connections(site: Site, limits: AddressLimits) -> None:
    """Apply ``limits`` and the deadlines of this module to the connections of ``site``."""
    configured: Any = site
    configured.protocol = Channel
    configured.limits = limits
    configured.timeOut = None
    # Channel implements HTTP/1.1 only, also if the package h2 is installed.
    configured.acceptableProtocols = lambda: [b"http/1.1"]
