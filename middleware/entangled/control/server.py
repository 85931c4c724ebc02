"""The control socket of one node; each connection carries one request and its answers as lines of JSON.

A request is ``{"verb": "dht get", "with": {"key": "a"}}``.  The node replies with any number of lines ``{"event":
...}`` and one line ``{"answer": ...}`` or ``{"error": "Unavailable", "text": "..."}``, and then closes the connection.
A client cancels the request by closing the connection earlier.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from typing import Protocol as Shape

from twisted.application.service import Service
from twisted.internet.defer import CancelledError, Deferred, maybeDeferred
from twisted.internet.error import CannotListenError
from twisted.internet.interfaces import IAddress
from twisted.internet.protocol import Factory, Protocol, connectionDone
from twisted.logger import Logger
from twisted.python.failure import Failure

from middleware.entangled.errors import EntangledError

MAX_REQUEST_BYTES = 2_000_000
"""Maximum bytes of a request: a value of 1 MiB in base64, and the other fields."""
MAX_CONNECTIONS = 64


class ControlProtocol(Protocol):
    """One connection."""

    _log = Logger()

    def __init__(self, server: ControlServer) -> None:
        self._server = server
        self._buffer = bytearray()
        self._work: Deferred[Any] | None = None
        self._has_request = False

    def connectionMade(self) -> None:  # noqa: D102 (Twisted's)
        self._server.connections.add(self)
        if len(self._server.connections) > MAX_CONNECTIONS:
            self._end(
                {
                    "error": "Busy",
                    "text": f"the limit of {MAX_CONNECTIONS} connections is reached; close some of them",
                }
            )

    def dataReceived(self, data: bytes) -> None:  # noqa: D102 (Twisted's)
        if self._has_request:
            return
        self._buffer += data
        line, newline, _ = self._buffer.partition(b"\n")
        if len(line) > MAX_REQUEST_BYTES:
            self._has_request = True
            self._end({"error": "BadRequest", "text": f"the request must have at most {MAX_REQUEST_BYTES} bytes"})
        elif newline:
            self._has_request = True
            self._buffer.clear()
            self._run_request(bytes(line))

    def connectionLost(self, reason: Failure = connectionDone) -> None:  # noqa: D102 (Twisted's)
        self._server.connections.discard(self)
        work, self._work = self._work, None
        if work is not None:
            work.cancel()

    def _run_request(self, line: bytes) -> None:
        try:
            request = json.loads(line)
        except (ValueError, RecursionError):
            request = None
        if not isinstance(request, dict):
            self._end({"error": "BadRequest", "text": "the request must be one line with a JSON object"})
            return
        work = self._server.handler.run(request.get("verb"), request.get("with", {}), self._send_event)
        self._work = work
        work.addCallbacks(lambda answer: {"answer": answer}, self._make_error).addCallback(self._end)

    def _send_event(self, event: Any) -> None:
        self._write({"event": event})

    def _make_error(self, failure: Failure) -> dict[str, Any]:
        if failure.check(CancelledError) is not None:
            return {"error": "Cancelled", "text": "cancelled"}
        if failure.check(EntangledError, ValueError) is None:
            self._log.failure("a verb of the control socket failed", failure=failure)
        return {"error": failure.type.__name__ if failure.type else "Error", "text": failure.getErrorMessage()}

    def _end(self, line: dict[str, Any]) -> None:
        self._work = None
        self._write(line)
        if self.transport is not None:
            self.transport.loseConnection()

    def _write(self, line: dict[str, Any]) -> None:
        if self.connected and self.transport is not None:
            self.transport.write(json.dumps(line, ensure_ascii=False).encode() + b"\n")


class RequestRunner(Shape):
    """Runs verbs; ``control.request_handler.RequestHandler`` implements it."""

    def run(self, name: object, arguments: object, send_event: Callable[[Any], None]) -> Deferred[Any]:
        """Run the verb ``name``; see ``RequestHandler.run``."""


class ControlServer(Service):
    """The control socket of one node, open while the service runs.

    ``make_handler`` is called at the first request, so a node without requests does not load the verbs.
    """

    _log = Logger()

    def __init__(self, reactor: Any, path: Path, make_handler: Callable[[], RequestRunner]) -> None:
        self.connections: set[ControlProtocol] = set()
        self._make_handler = make_handler
        self._handler: RequestRunner | None = None
        self._reactor = reactor
        self._path = path
        self._port: Any = None

    @property
    def handler(self) -> RequestRunner:
        """The verbs, created on first use."""
        if self._handler is None:
            self._handler = self._make_handler()
        return self._handler

    def startService(self) -> None:
        """Listen; on failure log the reason and run without the socket."""
        super().startService()
        factory = _ConnectionFactory(self)
        try:
            # With the lock file, Twisted removes the socket of a killed node, but not the socket of a running node.
            self._port = self._reactor.listenUNIX(str(self._path), factory, mode=0o600, wantPID=True)
        except (CannotListenError, OSError) as error:
            self._log.warn("cannot listen at the control socket {path}: {error}", path=self._path, error=error)

    def stopService(self) -> Deferred[object]:
        """Close the socket and cancel running requests."""
        super().stopService()
        for connection in list(self.connections):
            if connection.transport is not None:
                connection.transport.loseConnection()
        port, self._port = self._port, None
        return maybeDeferred(port.stopListening if port is not None else lambda: None)


class _ConnectionFactory(Factory):
    noisy = False

    def __init__(self, server: ControlServer) -> None:
        self._server = server

    def buildProtocol(self, addr: IAddress | None) -> ControlProtocol:
        return ControlProtocol(self._server)
