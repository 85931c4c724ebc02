"""Websocket: one end of a WebSocket (RFC 6455), by ``wsproto``: bytes in, messages and bytes out.

This adds what ``wsproto`` leaves to its caller: limits of the greeting, of a message and of the frames in one read, and
an answer to whatever is no WebSocket.  No extension is offered or taken, so nothing arrives compressed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from wsproto import ConnectionType, WSConnection
from wsproto.connection import ConnectionState
from wsproto.events import (
    AcceptConnection,
    BytesMessage,
    CloseConnection,
    Event,
    Message,
    Ping,
    Pong,
    RejectConnection,
    Request,
    TextMessage,
)
from wsproto.utilities import LocalProtocolError, RemoteProtocolError

from formats.head import MAX_HEAD

NORMAL, BAD = 1000, 1002
"""Reasons to close."""
MAX_FRAMES = 2048
"""Frames in one read of at most 64 KiB; more are a flood of nearly empty ones, which cost more to take than to send."""


class End(ABC):
    """One end of a connection: the client's where ``request`` is given.

    After ``fault`` nothing more is received: close the stream, and open another.  A subclass judges the greeting of the
    other end.  ``longest`` is the most bytes of a message.
    """

    def __init__(self, longest: int, request: Request | None = None, takes_text: bool = True) -> None:
        self.is_open = False
        self.fault = ""
        self.frames = 0
        """Whole ones received; while bytes come and this does not grow, a spoilt length may be waited for."""
        self._request = request
        self._longest = longest
        self._takes_text = takes_text
        self._socket = WSConnection(ConnectionType.SERVER if request is None else ConnectionType.CLIENT)
        self._greeting = 0
        self._left = MAX_FRAMES
        self._part = bytearray()
        self._messages: list[bytes] = []
        self._reply: list[bytes] = []

    def opening(self) -> bytes:
        """Return the request of a client; a server sends nothing first."""
        return b"" if self._request is None else self._send(self._request)

    def received(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Take bytes as they come, cut anyhow; the messages that they complete, and what to send back at once."""
        if self.fault or not data:
            return [], b""
        self._left = MAX_FRAMES
        self._greeting += 0 if self.is_open else len(data)
        try:
            self._socket.receive_data(data)
            for event in self._socket.events():
                if not self._is_taken(event):
                    break
        except (RemoteProtocolError, LocalProtocolError, ValueError) as error:  # ValueError: a head in no known charset
            self._refuse(error)
        if not (self.is_open or self.fault) and self._greeting >= MAX_HEAD:
            self.fault = f"no end of the greeting in {MAX_HEAD} bytes; no WebSocket speaks there"
        messages, self._messages = self._messages, []
        reply, self._reply = b"".join(self._reply), []
        return messages, reply

    def framed(self, payload: bytes) -> bytes:
        """Return a binary message as one frame, or nothing once the connection closes."""
        return self._send(BytesMessage(payload))

    def text(self, payload: bytes) -> bytes:
        """Return a text in UTF-8 as one frame, or nothing once the connection closes."""
        return self._send(TextMessage(payload.decode()))

    def ping(self) -> bytes:
        """A frame that the other end answers by itself."""
        return self._send(Ping())

    def closing(self, code: int = NORMAL) -> bytes:
        """Return the frame that closes the connection, or nothing if it was sent already."""
        return self._send(CloseConnection(code))

    # -- for subclasses ---------------------------------------------------------------------------------------------

    @abstractmethod
    def _answer(self, request: Request) -> AcceptConnection | RejectConnection:
        """Return the server's answer to a request."""

    @abstractmethod
    def _fault_of(self, answer: AcceptConnection | RejectConnection | Exception) -> str:
        """Return the fault of a server's answer, or an empty text if frames may follow."""

    # -- inside -----------------------------------------------------------------------------------------------------

    def _send(self, event: Event) -> bytes:
        try:
            return self._socket.send(event)
        except LocalProtocolError:
            return b""  # it is not open yet, or is closing

    def _is_taken(self, event: Event) -> bool:
        """Take an event; return False if it ends the connection."""
        self._left -= 1
        if self._left < 0:
            self._fail(f"more than {MAX_FRAMES} frames at once")
        elif isinstance(event, Message):
            self._join(event)
        elif isinstance(event, Ping | Pong):
            self.frames += 1
            if isinstance(event, Ping):
                self._reply.append(self._send(event.response()))
        elif isinstance(event, CloseConnection):
            if self._socket.state is ConnectionState.OPEN:
                self._fail(event.reason or "a frame that is none", event.code)
            else:
                self.frames += 1
                self.fault = "the other end said goodbye"
                self._reply.append(self._send(event.response()))
        elif isinstance(event, Request):
            answer = self._answer(event)
            self._reply.append(self._send(answer))
            self.is_open = isinstance(answer, AcceptConnection)
            self.fault = "" if self.is_open else "a request for something else"
        elif isinstance(event, AcceptConnection | RejectConnection):
            self.fault = self._fault_of(event)
            self.is_open = not self.fault
        return not self.fault

    def _join(self, event: Message[Any]) -> None:
        self.frames += event.frame_finished
        self._part += event.data.encode() if isinstance(event.data, str) else event.data
        if isinstance(event, TextMessage) and not self._takes_text:
            self._fail("a text where only bytes belong")
        elif len(self._part) > self._longest:
            self._fail(f"a message of more than {self._longest} bytes")
        elif event.message_finished:
            self._messages.append(bytes(self._part))
            self._part = bytearray()

    def _fail(self, why: str, code: int = BAD) -> None:
        self.fault = why
        self._reply.append(self.closing(code))

    def _refuse(self, error: Exception) -> None:
        """End a connection that is no WebSocket; a server answers in HTTP."""
        if self.is_open:
            self._fail(str(error))
        elif self._request is not None:
            self.fault = self._fault_of(error)
        else:
            self.fault = f"no WebSocket greeting: {error}"
            hint = getattr(error, "event_hint", None) or RejectConnection()
            self._reply.append(self._send(hint))
