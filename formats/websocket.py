"""Implement one end of a WebSocket (RFC 6455) without I/O, based on ``wsproto``.

This module adds what ``wsproto`` leaves to its caller: limits for the handshake, for a message and for the frames in
one read, and an HTTP response to requests that are not a handshake. Extensions are disabled, so messages are not
compressed.
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

from formats.head import MAX_HEAD_BYTES

CLOSE_NORMAL, CLOSE_PROTOCOL_ERROR = 1000, 1002
"""Close codes: normal closure and protocol error."""
MAX_FRAMES = 2048
"""The maximum number of frames in one read of at most 64 KiB; with more, the frames are nearly empty, and cost more to
receive than to send."""


class WebSocketEnd(ABC):
    """One end of a connection: the client if ``request`` is given, else the server.

    After a ``fault`` received data is ignored, and the caller has to close the stream. A subclass checks the handshake
    of the other end. ``longest`` is the maximum length of a message in bytes.
    """

    def __init__(self, longest: int, request: Request | None = None, takes_text: bool = True) -> None:
        self.is_open = False
        self.fault = ""
        self.frames = 0
        """The number of complete frames received. If bytes arrive but this number does not grow, the length of a frame
        may be corrupt."""
        self._request = request
        self._max_message_bytes = longest
        self._takes_text = takes_text
        self._socket = WSConnection(ConnectionType.SERVER if request is None else ConnectionType.CLIENT)
        self._handshake_bytes = 0
        self._frames_left = MAX_FRAMES
        self._partial_message = bytearray()
        self._messages: list[bytes] = []
        self._reply: list[bytes] = []

    def opening(self) -> bytes:
        """Return the request of a client; a server sends nothing first."""
        return b"" if self._request is None else self._send(self._request)

    def receive_data(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Process received bytes; return the messages that they complete, and the bytes to send back immediately."""
        if self.fault or not data:
            return [], b""
        self._frames_left = MAX_FRAMES
        self._handshake_bytes += 0 if self.is_open else len(data)
        try:
            self._socket.receive_data(data)
            for event in self._socket.events():
                if not self._process_event(event):
                    break
        # ValueError: the head has an unknown charset
        except (RemoteProtocolError, LocalProtocolError, ValueError) as error:
            self._reject_handshake(error)
        if not (self.is_open or self.fault) and self._handshake_bytes >= MAX_HEAD_BYTES:
            self.fault = f"the handshake is longer than {MAX_HEAD_BYTES} bytes; the other end is not a WebSocket"
        messages, self._messages = self._messages, []
        reply, self._reply = b"".join(self._reply), []
        return messages, reply

    def encode_binary(self, payload: bytes) -> bytes:
        """Return a binary message as one frame, or nothing if the connection is closing."""
        return self._send(BytesMessage(payload))

    def encode_text(self, payload: bytes) -> bytes:
        """Return a UTF-8 text message as one frame, or nothing if the connection is closing."""
        return self._send(TextMessage(payload.decode()))

    def encode_ping(self) -> bytes:
        """Return a ping frame."""
        return self._send(Ping())

    def encode_close(self, code: int = CLOSE_NORMAL) -> bytes:
        """Return the frame that closes the connection, or nothing if the frame was already sent."""
        return self._send(CloseConnection(code))

    # -- for subclasses ---------------------------------------------------------------------------------------------

    @abstractmethod
    def _make_response(self, request: Request) -> AcceptConnection | RejectConnection:
        """Return the server's response to a request."""

    @abstractmethod
    def _find_error(self, answer: AcceptConnection | RejectConnection | Exception) -> str:
        """Return the fault in a server's response; empty if the response is correct and frames may follow."""

    # -- private ----------------------------------------------------------------------------------------------------

    def _send(self, event: Event) -> bytes:
        try:
            return self._socket.send(event)
        except LocalProtocolError:
            return b""  # the connection is not open yet, or is closing

    def _process_event(self, event: Event) -> bool:
        """Process an event; return False if it ends the connection."""
        self._frames_left -= 1
        if self._frames_left < 0:
            self._fail(f"the other end sent more than {MAX_FRAMES} frames in one read")
        elif isinstance(event, Message):
            self._add_frame(event)
        elif isinstance(event, Ping | Pong):
            self.frames += 1
            if isinstance(event, Ping):
                self._reply.append(self._send(event.response()))
        elif isinstance(event, CloseConnection):
            if self._socket.state is ConnectionState.OPEN:
                self._fail(event.reason or "an invalid frame", event.code)
            else:
                self.frames += 1
                self.fault = "the other end closed the connection"
                self._reply.append(self._send(event.response()))
        elif isinstance(event, Request):
            answer = self._make_response(event)
            self._reply.append(self._send(answer))
            self.is_open = isinstance(answer, AcceptConnection)
            self.fault = "" if self.is_open else "the request was rejected"
        elif isinstance(event, AcceptConnection | RejectConnection):
            self.fault = self._find_error(event)
            self.is_open = not self.fault
        return not self.fault

    def _add_frame(self, event: Message[Any]) -> None:
        self.frames += event.frame_finished
        self._partial_message += event.data.encode() if isinstance(event.data, str) else event.data
        if isinstance(event, TextMessage) and not self._takes_text:
            self._fail("the other end sent a text message, but only binary messages are allowed")
        elif len(self._partial_message) > self._max_message_bytes:
            self._fail(f"the other end sent a message of more than {self._max_message_bytes} bytes")
        elif event.message_finished:
            self._messages.append(bytes(self._partial_message))
            self._partial_message = bytearray()

    def _fail(self, reason: str, code: int = CLOSE_PROTOCOL_ERROR) -> None:
        self.fault = reason
        self._reply.append(self.encode_close(code))

    def _reject_handshake(self, error: Exception) -> None:
        """Close a connection that is not a WebSocket; a server sends an HTTP response."""
        if self.is_open:
            self._fail(str(error))
        elif self._request is not None:
            self.fault = self._find_error(error)
        else:
            self.fault = f"not a WebSocket handshake: {error}"
            hint = getattr(error, "event_hint", None) or RejectConnection()
            self._reply.append(self._send(hint))
