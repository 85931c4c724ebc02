"""Encode frames and the handshake of RFC 6455, including content that ``wsproto`` would not send."""

from __future__ import annotations

import base64
import hashlib
import re
import struct

CONTINUATION, TEXT, BINARY, CLOSE, PING, PONG = 0x0, 0x1, 0x2, 0x8, 0x9, 0xA
MASK = bytes.fromhex("37fa213d")


def answer_to(request: bytes) -> bytes:
    """Return a server's response to the opening handshake of a client."""
    found = re.search(rb"Sec-WebSocket-Key: (\S+)", request, re.IGNORECASE)
    assert found
    key = hashlib.sha1(found[1] + b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11", usedforsecurity=False).digest()
    head = b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    return head + b"Sec-WebSocket-Accept: " + base64.b64encode(key) + b"\r\n\r\n"


def framed(opcode: int, payload: bytes, mask: bytes | None) -> bytes:
    """Return one complete frame; ``mask`` has 4 bytes for a client and is empty for a server."""
    size, bit = len(payload), 0 if mask is None else 0x80
    if size < 126:
        start = bytes([0x80 | opcode, bit | size])
    elif size < 65536:
        start = struct.pack(">BBH", 0x80 | opcode, bit | 126, size)
    else:
        start = struct.pack(">BBQ", 0x80 | opcode, bit | 127, size)
    return start + payload if mask is None else start + mask + masked(payload, mask)


def masked(payload: bytes, mask: bytes) -> bytes:
    """Mask or unmask a payload with 4 bytes."""
    return bytes(byte ^ mask[place % 4] for place, byte in enumerate(payload))
