"""A programmatic client of a web node's page.

It follows the live stream of states, and sends orders through the HTTP API.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from io import BytesIO
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime
from twisted.internet.protocol import Protocol, connectionDone
from twisted.python.failure import Failure
from twisted.web.client import Agent, FileBodyProducer, readBody
from twisted.web.http_headers import Headers
from twisted.web.iweb import IBodyProducer, IResponse

RETRY_S = 0.5
REQUEST_LIMIT_S = 5.0
MAX_EVENT_BYTES = 1 << 20


class PageError(Exception):
    """The page refused a request or sent an invalid answer; the message contains the page's text."""


class EventParser:
    """A parser of server-sent events for any chunks of bytes; an event above one MiB is dropped."""

    def __init__(self) -> None:
        self._buffer = b""
        self._name = "message"
        self._data: list[bytes] = []

    def feed(self, data: bytes) -> list[tuple[str, bytes]]:
        """Parse more bytes; returns the completed events, each with its name and data."""
        events = []
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        if len(self._buffer) > MAX_EVENT_BYTES:
            self._buffer, self._data = b"", []
        for line in lines:
            line = line.removesuffix(b"\r")
            field, _, value = line.partition(b":")
            value = value.removeprefix(b" ")
            if not line:
                if self._data:
                    events.append((self._name, b"\n".join(self._data)))
                self._name, self._data = "message", []
            elif field == b"event":
                self._name = value.decode(errors="replace")
            elif field == b"data":
                self._data.append(value)
        return events


class PageClient:
    """A client of the page at ``http://HOST:PORT``.

    ``on_state(before, after)`` is called for each new state; ``state`` is the newest, empty before the first one.
    ``code`` is the sign-in code; the client signs in again when its session has ended.
    """

    def __init__(
        self,
        reactor: Any,
        host: str,
        port: int,
        on_state: Callable[[dict[str, Any], dict[str, Any]], None],
        code: str = "",
    ) -> None:
        self.state: dict[str, Any] = {}
        self._clock = IReactorTime(reactor)
        self._agent = Agent(reactor, connectTimeout=REQUEST_LIMIT_S)
        self._address = f"http://{host}:{port}"
        self._on_state = on_state
        self._code = code
        self._token = ""
        self._stream: _StreamProtocol | None = None
        self._retry: IDelayedCall | None = None
        self._following = False

    def follow(self) -> None:
        """Follow the live states until ``stop``; a lost stream is reopened."""
        self._following = True
        self._open()

    def stop(self) -> None:
        """Stop following."""
        self._following = False
        if self._retry is not None and self._retry.active():
            self._retry.cancel()
        if self._stream is not None and self._stream.transport is not None:
            self._stream.transport.loseConnection()

    async def post(self, path: str) -> dict[str, Any]:
        """Send an order to the page; raises ``PageError`` if it is refused."""
        await self._sign_in()
        return await self._post(path, None)

    async def _post(self, path: str, body: IBodyProducer | None) -> dict[str, Any]:
        asked = self._agent.request(b"POST", (self._address + path).encode(), self._headers(), body)
        response = await asked.addTimeout(REQUEST_LIMIT_S, self._clock)
        content = await readBody(response).addTimeout(REQUEST_LIMIT_S, self._clock)
        try:
            answer = json.loads(content)
        except ValueError:
            answer = None
        if response.code == 401:
            self._token = ""
        if response.code >= 400 or not isinstance(answer, dict):
            raise PageError(f"{path}: {response.code} {content[:200].decode(errors='replace')}")
        return answer

    async def _sign_in(self) -> None:
        if self._code and not self._token:
            body = FileBodyProducer(BytesIO(json.dumps({"code": self._code}).encode()))
            answer = await self._post("/api/v1/session", body)
            self._token = str(answer.get("token", ""))

    def _headers(self) -> Headers:
        signed = {"Authorization": [f"Bearer {self._token}"]} if self._token else {}
        return Headers({"X-Swarm": ["1"], **signed})

    def _open(self) -> None:
        Deferred.fromCoroutine(self._request_stream()).addCallbacks(self._on_open, self._on_lost)

    async def _request_stream(self) -> IResponse:
        await self._sign_in()
        response = await self._agent.request(b"GET", f"{self._address}/events?whole=1".encode(), self._headers())
        if response.code == 401:
            self._token = ""
        return response

    def _on_open(self, response: IResponse) -> None:
        self._stream = _StreamProtocol(self._on_event)
        self._stream.closed.addBoth(self._on_lost)
        response.deliverBody(self._stream)
        if not self._following:
            self.stop()

    def _on_lost(self, _: object) -> None:
        self._stream = None
        if self._following:
            self._retry = self._clock.callLater(RETRY_S, self._open)

    def _on_event(self, name: str, data: bytes) -> None:
        if name != "state":
            return
        try:
            state = json.loads(data)
        except ValueError:
            return
        if isinstance(state, dict):
            before, self.state = self.state, state
            self._on_state(before, state)


class _StreamProtocol(Protocol):
    def __init__(self, on_event: Callable[[str, bytes], None]) -> None:
        self.closed: Deferred[None] = Deferred()
        self._events = EventParser()
        self._on_event = on_event

    def dataReceived(self, data: bytes) -> None:
        for name, event in self._events.feed(data):
            self._on_event(name, event)

    def connectionLost(self, reason: Failure = connectionDone) -> None:
        self.closed.callback(None)
