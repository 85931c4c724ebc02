"""The examples of RFC 6455, sections 1.3 and 5.7, as far as several tests need them."""

from __future__ import annotations

MASK = bytes.fromhex("37fa213d")
ANSWER = (
    b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Accept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo=\r\n\r\n"
)


def nonce(size: int) -> bytes:
    """The nonces of the examples."""
    return b"the sample nonce" if size == 16 else MASK
