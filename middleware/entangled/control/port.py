"""Port: the control socket of one node; a connection carries one request and its answers, each a line of JSON.

A request is ``{"verb": "dht get", "with": {"key": "a"}}``.  Lines come back: any number of ``{"event": ...}``, then one
of ``{"answer": ...}`` or ``{"error": "Unavailable", "text": "..."}``, and the connection closes.  Who closes it earlier
cancels what was asked for.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.interfaces import IAddress
from twisted.internet.protocol import Factory, Protocol, connectionDone
from twisted.logger import Logger
from twisted.python.failure import Failure

from middleware.entangled.control.verb import Verbs
from middleware.entangled.errors import EntangledError

MAX_REQUEST = 2_000_000
"""Bytes of a request: a value of 1 MiB in base64, and room for the rest."""
MAX_CONNECTIONS = 64


class ControlProtocol(Protocol):
    """One connection."""

    _log = Logger()

    def __init__(self, port: ControlPort) -> None:
        self._port = port
        self._heard = bytearray()
        self._work: Deferred[Any] | None = None
        self._is_asked = False

    def connectionMade(self) -> None:  # noqa: D102 (Twisted's)
        self._port.open.add(self)
        if len(self._port.open) > MAX_CONNECTIONS:
            self._end({"error": "Busy", "text": f"more than {MAX_CONNECTIONS} connections; close some"})

    def dataReceived(self, data: bytes) -> None:  # noqa: D102 (Twisted's)
        if self._is_asked:
            return
        self._heard += data
        line, newline, _ = self._heard.partition(b"\n")
        if len(line) > MAX_REQUEST:
            self._is_asked = True
            self._end({"error": "BadRequest", "text": f"a request has at most {MAX_REQUEST} bytes"})
        elif newline:
            self._is_asked = True
            self._heard.clear()
            self._ask(bytes(line))

    def connectionLost(self, reason: Failure = connectionDone) -> None:  # noqa: D102 (Twisted's)
        self._port.open.discard(self)
        work, self._work = self._work, None
        if work is not None:
            work.cancel()

    def _ask(self, line: bytes) -> None:
        try:
            request = json.loads(line)
        except (ValueError, RecursionError):
            request = None
        if not isinstance(request, dict):
            self._end({"error": "BadRequest", "text": "a request is one line with a JSON object"})
            return
        work = self._port.verbs.run(request.get("verb"), request.get("with", {}), self._tell)
        self._work = work
        work.addCallbacks(lambda answer: {"answer": answer}, self._trouble).addCallback(self._end)

    def _tell(self, event: Any) -> None:
        self._write({"event": event})

    def _trouble(self, failure: Failure) -> dict[str, Any]:
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


class ControlPort(Factory):
    """The open control socket of ``verbs``' node; ``start`` and ``stop`` once."""

    noisy = False

    def __init__(self, reactor: Any, path: Path, verbs: Verbs) -> None:
        self.verbs = verbs
        self.open: set[ControlProtocol] = set()
        self._reactor = reactor
        self._path = path
        self._port: Any = None

    def buildProtocol(self, addr: IAddress | None) -> ControlProtocol:  # noqa: D102 (Twisted's)
        return ControlProtocol(self)

    def start(self) -> None:
        """Listen; raises ``twisted.internet.error.CannotListenError`` where a living node holds the path."""
        # With a lock file, so that what a killed node left behind is removed and what a living one holds is not.
        self._port = self._reactor.listenUNIX(str(self._path), self, mode=0o600, wantPID=True)

    def stop(self) -> None:
        """Close, and cancel what is still asked for."""
        if self._port is not None:
            self._port.stopListening()
            self._port = None
        for connection in list(self.open):
            if connection.transport is not None:
                connection.transport.loseConnection()
