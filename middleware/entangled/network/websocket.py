"""Websocket: datagrams as binary messages of RFC 6455, for both ends; bytes in, datagrams and bytes out.  Pure.

Only what a tunnel needs: no text, no extension, no message longer than a datagram.  (wsproto does all of it, for
0.8 MiB and 30 instead of 11 microseconds a datagram.)
"""

from __future__ import annotations

import base64
import hashlib
import re
import struct
from collections.abc import Callable, Iterator

from middleware.entangled.network.layer import MAX_HEAD
from middleware.entangled.network.url import PATH, Url

CONTINUATION, BINARY, CLOSE, PING, PONG = 0x0, 0x2, 0x8, 0x9, 0xA
NORMAL, BAD = 1000, 1002
GUID = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"
SUBPROTOCOL = "swarm-tunnel-1"
TOKEN = "X-Swarm-Tunnel"
"""The field of a request by which connections of one tunnel are known: 32 hexadecimal digits that nobody guesses."""
MAX_PAYLOAD = 2048
"""Bytes of a message; datagrams are shorter."""

Dice = Callable[[int], bytes]
"""So many bytes that nobody foresees."""


class WebSocket:
    """One end: the client's where ``url`` is given.  After ``fault`` nothing more is heard."""

    def __init__(self, dice: Dice, url: Url | None = None, token: bytes = b"") -> None:
        self.is_open = False
        self.fault = ""
        self.forwarded = ""
        """Whom a proxy before the server says that it speaks for, as it stands in its request."""
        self.token = token
        """What the client named its tunnel."""
        self._dice = dice
        self._url = url
        self._key = base64.b64encode(dice(16)) if url is not None else b""
        self._buffer = bytearray()
        self._begun: bytes | None = None
        self._reply: list[bytes] = []

    def opening(self) -> bytes:
        """What to send first: a client's request, and nothing of a server."""
        if self._url is None:
            return b""
        return _head(
            f"GET {self._url.path} HTTP/1.1",
            f"Host: {self._url.authority}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            f"Sec-WebSocket-Key: {self._key.decode()}",
            "Sec-WebSocket-Version: 13",
            f"Sec-WebSocket-Protocol: {SUBPROTOCOL}",
            f"{TOKEN}: {self.token.hex()}",
        )

    def received(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Take bytes as they come, cut anyhow; the datagrams that they complete, and what to send back at once."""
        if self.fault:
            return [], b""
        self._buffer += data
        if not self.is_open:
            self._greet()
        datagrams = list(self._datagrams()) if self.is_open else []
        reply, self._reply = b"".join(self._reply), []
        return datagrams, reply

    def framed(self, datagram: bytes) -> bytes:
        """A datagram as one frame."""
        return self._frame(BINARY, datagram)

    def ping(self) -> bytes:
        """A frame that the other end answers by itself."""
        return self._frame(PING, b"")

    def closing(self, code: int = NORMAL) -> bytes:
        """The frame that says goodbye."""
        return self._frame(CLOSE, struct.pack(">H", code))

    # -- the greeting -----------------------------------------------------------------------------------------------

    def _greet(self) -> None:
        end = self._buffer.find(b"\r\n\r\n", 0, MAX_HEAD)
        if end < 0:
            if len(self._buffer) >= MAX_HEAD:
                self.fault = f"no end of the greeting in {MAX_HEAD} bytes"
            return
        first, *rest = bytes(self._buffer[:end]).split(b"\r\n")
        del self._buffer[: end + 4]
        fields: dict[bytes, bytes] = {}
        for line in rest:
            name, _, value = line.partition(b":")
            fields[name.strip().lower()] = value.strip()
        if self._url is None:
            self._on_request(first, fields)
        else:
            self._on_answer(first, fields)

    def _on_answer(self, first: bytes, fields: dict[bytes, bytes]) -> None:
        if first.split(b" ")[:2] != [b"HTTP/1.1", b"101"]:
            self.fault = f"no tunnel begins there: {first[:60].decode('ascii', 'replace')!r}"
        elif fields.get(b"sec-websocket-accept") != _accepted(self._key):
            self.fault = "the answer is not to this request; is a proxy in between that keeps answers?"
        elif fields.get(b"sec-websocket-protocol") != SUBPROTOCOL.encode():
            self.fault = f"a WebSocket begins there, but no {SUBPROTOCOL}"
        self.is_open = not self.fault

    def _on_request(self, first: bytes, fields: dict[bytes, bytes]) -> None:
        method, path = [*first.split(b" "), b""][:2]
        key = fields.get(b"sec-websocket-key", b"")
        offered = [word.strip() for word in fields.get(b"sec-websocket-protocol", b"").split(b",")]
        if method != b"GET" or path.partition(b"?")[0] != PATH.encode():
            self._refuse("404 Not Found", "a request for something else")
        elif fields.get(b"upgrade", b"").lower() != b"websocket" or len(key) != 24:
            self._refuse("400 Bad Request", "a request without a WebSocket greeting")
        elif fields.get(b"sec-websocket-version") != b"13" or SUBPROTOCOL.encode() not in offered:
            self._refuse("426 Upgrade Required", "a WebSocket of another kind")
        else:
            self.forwarded = fields.get(b"x-forwarded-for", b"").rpartition(b",")[2].strip()[:45].decode("latin-1")
            said = fields.get(TOKEN.lower().encode(), b"")
            self.token = bytes.fromhex(said.decode()) if re.fullmatch(b"[0-9a-f]{32}", said) else b""
            self._reply.append(
                _head(
                    "HTTP/1.1 101 Switching Protocols",
                    "Upgrade: websocket",
                    "Connection: Upgrade",
                    f"Sec-WebSocket-Accept: {_accepted(key).decode()}",
                    f"Sec-WebSocket-Protocol: {SUBPROTOCOL}",
                )
            )
            self.is_open = True

    def _refuse(self, status: str, why: str) -> None:
        self.fault = why
        self._reply.append(_head(f"HTTP/1.1 {status}", "Sec-WebSocket-Version: 13", "Content-Length: 0"))

    # -- the frames -------------------------------------------------------------------------------------------------

    def _frame(self, opcode: int, payload: bytes) -> bytes:
        size, bit = len(payload), 0 if self._url is None else 0x80
        head = struct.pack(">BB", 0x80 | opcode, bit | size) if size < 126 else b""
        head = head or struct.pack(">BBH", 0x80 | opcode, bit | 126, size)
        if self._url is None:
            return head + payload
        mask = self._dice(4)
        return head + mask + _masked(payload, mask)

    def _datagrams(self) -> Iterator[bytes]:
        while (frame := self._next()) is not None:
            is_last, opcode, payload = frame
            if opcode == PING:
                self._reply.append(self._frame(PONG, payload))
            elif opcode == CLOSE:
                self.fault = "the other end said goodbye"
            elif opcode == PONG:
                pass
            elif opcode not in (CONTINUATION, BINARY):
                self._fail(f"a frame of kind {opcode}")
            elif (opcode == CONTINUATION) is (self._begun is None):
                self._fail("a message begins within another, or goes on without a beginning")
            else:
                whole = (self._begun or b"") + payload
                self._begun = None if is_last else whole
                if len(whole) > MAX_PAYLOAD:
                    self._fail(f"a message of more than {MAX_PAYLOAD} bytes")
                elif is_last:
                    yield whole

    def _fail(self, why: str) -> None:
        self.fault = why
        self._reply.append(self.closing(BAD))

    def _next(self) -> tuple[bool, int, bytes] | None:
        """The next whole frame, or None while there is none, or after a fault."""
        have = self._buffer
        if self.fault or len(have) < 2:
            return None
        opcode, size, is_masked = have[0] & 0x0F, have[1] & 0x7F, have[1] >= 0x80
        start, why = 2, ""
        if have[0] & 0x70:
            why = "an extension that nobody agreed on"
        elif is_masked is not (self._url is None):
            why = "a client masks its frames, and a server does not"
        elif opcode >= CLOSE and (size > 125 or have[0] < 0x80):
            why = "a control frame that is long, or in parts"
        elif size == 126:
            if len(have) < 4:
                return None
            start, size = 4, int.from_bytes(have[2:4], "big")
        if (size == 127 and start == 2) or size > MAX_PAYLOAD:
            why = f"a message of more than {MAX_PAYLOAD} bytes"
        if why:
            self._fail(why)
            return None
        mask = bytes(have[start : start + 4]) if is_masked else b""
        start += 4 * is_masked
        if len(have) < start + size:
            return None
        payload = bytes(have[start : start + size])
        is_last = have[0] >= 0x80
        del have[: start + size]
        return is_last, opcode, _masked(payload, mask) if is_masked else payload


def _masked(payload: bytes, mask: bytes) -> bytes:
    """The payload under (or from under) a mask of 4 bytes; as one large number, which is quick."""
    size = len(payload)
    key = (mask * (size // 4 + 1))[:size]
    return (int.from_bytes(payload, "big") ^ int.from_bytes(key, "big")).to_bytes(size, "big")


def _accepted(key: bytes) -> bytes:
    return base64.b64encode(hashlib.sha1(key + GUID, usedforsecurity=False).digest())


def _head(*lines: str) -> bytes:
    return ("\r\n".join(lines) + "\r\n\r\n").encode()
