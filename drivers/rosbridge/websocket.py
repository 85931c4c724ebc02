"""Websocket: RFC 6455 for both ends, as far as rosbridge uses it; bytes in, messages and bytes out.

Pure: the nonces and masks are handed in.  No extension is offered or taken, so nothing arrives compressed.
"""

from __future__ import annotations

import base64
import hashlib
import struct
from collections.abc import Callable, Iterator

CONTINUATION, TEXT, BINARY, CLOSE, PING, PONG = 0x0, 0x1, 0x2, 0x8, 0x9, 0xA
GUID = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"
MAX_HEAD = 8192
"""Bytes of a request or answer before the frames begin."""
MAX_MESSAGE = 4 * 1024 * 1024
"""Bytes of a message: a compressed picture of 2 megapixels fits, in base64."""

Nonce = Callable[[int], bytes]
"""So many bytes that nobody foresees (``os.urandom``)."""


class WebSocket:
    """One end of a connection.  After ``fault`` nothing more is heard: close the link, and open another."""

    def __init__(self, nonce: Nonce, host: str = "", path: str = "/", is_client: bool = True) -> None:
        self.is_open = False
        self.fault = ""
        self.frames = 0
        """Whole ones received; while bytes come and this does not grow, a spoilt length may be waited for."""
        self._is_client = is_client
        self._nonce = nonce
        self._host = host
        self._path = path
        self._key = base64.b64encode(nonce(16)) if is_client else b""
        self._buffer = bytearray()
        self._begun: bytearray | None = None
        self._reply: list[bytes] = []

    def opening(self) -> bytes:
        """What a client says first."""
        lines = (
            f"GET {self._path} HTTP/1.1",
            f"Host: {self._host}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            f"Sec-WebSocket-Key: {self._key.decode()}",
            "Sec-WebSocket-Version: 13",
        )
        return ("\r\n".join(lines) + "\r\n\r\n").encode()

    def received(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Take bytes as they come, cut anyhow; the messages that they complete, and what to send back at once."""
        if self.fault:
            return [], b""
        self._buffer += data
        messages: list[bytes] = []
        if not self.is_open:
            self._greet()
        if self.is_open:
            messages.extend(self._messages())
        reply, self._reply = b"".join(self._reply), []
        return messages, reply

    def text(self, payload: bytes) -> bytes:
        """A message as one frame."""
        return self._framed(TEXT, payload)

    def ping(self) -> bytes:
        """A frame that the other end answers by itself."""
        return self._framed(PING, b"")

    def closing(self) -> bytes:
        """The frame that says goodbye."""
        return self._framed(CLOSE, struct.pack(">H", 1000))

    def _framed(self, opcode: int, payload: bytes) -> bytes:
        return framed(opcode, payload, self._nonce(4) if self._is_client else None)

    # -- the greeting -----------------------------------------------------------------------------------------------

    def _greet(self) -> None:
        end = self._buffer.find(b"\r\n\r\n")
        if end < 0:
            if len(self._buffer) > MAX_HEAD:
                self.fault = f"no end of the greeting in {MAX_HEAD} bytes; no WebSocket speaks there"
            return
        first, *rest = bytes(self._buffer[:end]).split(b"\r\n")
        del self._buffer[: end + 4]
        fields: dict[bytes, bytes] = {}
        for line in rest:
            name, _, value = line.partition(b":")
            fields[name.strip().lower()] = value.strip()
        is_upgrade = fields.get(b"upgrade", b"").lower() == b"websocket"
        if self._is_client:
            self._on_answer(first, is_upgrade and fields.get(b"sec-websocket-accept") == accepted(self._key))
        else:
            self._on_request(first, fields.get(b"sec-websocket-key", b"") if is_upgrade else b"")

    def _on_answer(self, first: bytes, is_accepted: bool) -> None:
        said = first[:60].decode("ascii", "replace")
        if first.split(b" ")[:2] != [b"HTTP/1.1", b"101"]:
            self.fault = f"no rosbridge answers there, but: {said!r}; look at host, port and path"
        elif not is_accepted:
            self.fault = "the answer is not to our greeting; is a proxy in between?"
        self.is_open = not self.fault

    def _on_request(self, first: bytes, key: bytes) -> None:
        if not first.startswith(b"GET ") or not key:
            self.fault = "no WebSocket greeting"
            self._reply.append(b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\n\r\n")
            return
        head = b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        self._reply.append(head + b"Sec-WebSocket-Accept: " + accepted(key) + b"\r\n\r\n")
        self.is_open = True

    # -- the frames -------------------------------------------------------------------------------------------------

    def _messages(self) -> Iterator[bytes]:
        while (frame := self._frame()) is not None:
            is_last, opcode, payload = frame
            if opcode == PING:
                self._reply.append(self._framed(PONG, payload))
            elif opcode == CLOSE:
                self.fault = "the other end said goodbye"
                self._reply.append(self._framed(CLOSE, payload[:2]))
            elif opcode == PONG:
                pass
            elif opcode not in (CONTINUATION, TEXT, BINARY):
                self.fault = f"opcode {opcode} is none"
            elif (opcode == CONTINUATION) is (self._begun is None):
                self.fault = "a message begins within another, or goes on without a beginning"
            else:
                yield from self._joined(is_last, payload)

    def _joined(self, is_last: bool, payload: bytes) -> Iterator[bytes]:
        if self._begun is None and is_last:
            yield payload
            return
        if self._begun is None:
            self._begun = bytearray()
        self._begun += payload
        if len(self._begun) > MAX_MESSAGE:
            self.fault = f"a message has more than {MAX_MESSAGE} bytes"
        elif is_last:
            whole, self._begun = bytes(self._begun), None
            yield whole

    def _frame(self) -> tuple[bool, int, bytes] | None:
        """The next whole frame, or None while there is none, or after a fault."""
        have = self._buffer
        if self.fault or len(have) < 2:
            return None
        opcode, length, is_masked = have[0] & 0x0F, have[1] & 0x7F, have[1] >= 0x80
        if have[0] & 0x70:
            self.fault = "a frame uses an extension that nobody agreed on"
        elif is_masked is self._is_client:
            self.fault = "a client masks its frames, and a server does not"
        elif opcode >= CLOSE and (length > 125 or have[0] < 0x80):
            self.fault = "a control frame is long, or in parts"
        if self.fault:
            return None
        start = 2
        if length >= 126:
            size = 2 if length == 126 else 8
            start += size
            if len(have) < start:
                return None
            length = int.from_bytes(have[2:start], "big")
        if length > MAX_MESSAGE:
            self.fault = f"a message has more than {MAX_MESSAGE} bytes"
            return None
        mask = b""
        if is_masked:
            start += 4
            mask = bytes(have[start - 4 : start])
        if len(have) < start + length:
            return None
        payload = bytes(have[start : start + length])
        is_last = have[0] >= 0x80
        del have[: start + length]
        self.frames += 1
        return is_last, opcode, masked(payload, mask) if is_masked else payload


def framed(opcode: int, payload: bytes, mask: bytes | None) -> bytes:
    """One whole frame; a client gives 4 bytes of ``mask``, a server none."""
    size, bit = len(payload), 0 if mask is None else 0x80
    if size < 126:
        head = bytes([0x80 | opcode, bit | size])
    elif size < 65536:
        head = struct.pack(">BBH", 0x80 | opcode, bit | 126, size)
    else:
        head = struct.pack(">BBQ", 0x80 | opcode, bit | 127, size)
    return head + payload if mask is None else head + mask + masked(payload, mask)


def masked(payload: bytes, mask: bytes) -> bytes:
    """The payload under (or from under) a mask of 4 bytes; as one large number, or a picture would take long."""
    size = len(payload)
    key = (mask * (size // 4 + 1))[:size]
    return (int.from_bytes(payload, "big") ^ int.from_bytes(key, "big")).to_bytes(size, "big")


def accepted(key: bytes) -> bytes:
    """What a server answers to the key of a client."""
    return base64.b64encode(hashlib.sha1(key + GUID, usedforsecurity=False).digest())
