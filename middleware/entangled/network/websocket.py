"""Websocket: datagrams as binary messages, for both ends; greeting and frames are those of ``standards``.  Pure.

Only what a tunnel needs: no text, no message longer than a datagram.
"""

from __future__ import annotations

import re

from middleware.entangled.network.url import PATH, Url
from standards.head import Head, head
from standards.websocket import BAD, BINARY, KEY, End, Nonce, is_switch, is_upgrade, switch

SUBPROTOCOL = "swarm-tunnel-1"
TOKEN = "X-Swarm-Tunnel"
"""The field of a request by which connections of one tunnel are known: 32 hexadecimal digits that nobody guesses."""
MAX_PAYLOAD = 2048
"""Bytes of a message; datagrams are shorter."""
_SPOKEN = f"Sec-WebSocket-Protocol: {SUBPROTOCOL}"


class WebSocket(End):
    """One end of a tunnel: the client's where ``url`` is given."""

    def __init__(self, nonce: Nonce, url: Url | None = None, token: bytes = b"") -> None:
        super().__init__(nonce, url is not None, MAX_PAYLOAD, BINARY)
        self.forwarded = ""
        """Whom a proxy before the server says that it speaks for, as it stands in its request."""
        self.token = token
        """What the client named its tunnel."""
        self._url = url

    def opening(self) -> bytes:
        """What to send first: a client's request, and nothing of a server."""
        if self._url is None:
            return b""
        return self._request(self._url.path, self._url.authority, _SPOKEN, f"{TOKEN}: {self.token.hex()}")

    def framed(self, datagram: bytes) -> bytes:
        """A datagram as one frame."""
        return self._framed(BINARY, datagram)

    def _fault_of_answer(self, answer: Head) -> str:
        if not is_switch(answer):
            return f"no tunnel begins there: {answer.said!r}"
        if not self._is_accepted(answer):
            return "the answer is not to this request; is a proxy in between that keeps answers?"
        if answer.fields.get(b"sec-websocket-protocol") != SUBPROTOCOL.encode():
            return f"a WebSocket begins there, but no {SUBPROTOCOL}"
        return ""

    def _fault_of_request(self, request: Head) -> str:
        method, path = [*request.first.split(b" "), b""][:2]
        fields = request.fields
        key = fields.get(KEY, b"")
        offered = [word.strip() for word in fields.get(b"sec-websocket-protocol", b"").split(b",")]
        if method != b"GET" or path.partition(b"?")[0] != PATH.encode():
            return self._refused("404 Not Found", "a request for something else")
        if not is_upgrade(request) or len(key) != 24:
            return self._refused("400 Bad Request", "a request without a WebSocket greeting")
        if fields.get(b"sec-websocket-version") != b"13" or SUBPROTOCOL.encode() not in offered:
            return self._refused("426 Upgrade Required", "a WebSocket of another kind")
        self.forwarded = fields.get(b"x-forwarded-for", b"").rpartition(b",")[2].strip()[:45].decode("latin-1")
        said = fields.get(TOKEN.lower().encode(), b"")
        self.token = bytes.fromhex(said.decode()) if re.fullmatch(b"[0-9a-f]{32}", said) else b""
        self._put(switch(key, _SPOKEN))
        return ""

    def _refused(self, status: str, why: str) -> str:
        self._put(head(f"HTTP/1.1 {status}", "Sec-WebSocket-Version: 13", "Content-Length: 0"))
        return why

    def _last_words(self, goodbye: bytes | None) -> bytes:
        return self.closing(BAD) if goodbye is None else b""
