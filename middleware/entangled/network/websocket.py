"""Websocket: datagrams as binary messages, for both ends: no text, no message longer than a datagram."""

from __future__ import annotations

import re

from wsproto.events import AcceptConnection, RejectConnection, Request

from formats.websocket import End
from middleware.entangled.network.url import PATH, Url

SUBPROTOCOL = "swarm-tunnel-1"
TOKEN = "X-Swarm-Tunnel"
"""The field of a request by which connections of one tunnel are known: 32 hexadecimal digits that nobody guesses."""
MAX_PAYLOAD = 2048
"""Bytes of a message; datagrams are shorter."""


class WebSocket(End):
    """One end of a tunnel: the client's where ``url`` is given."""

    def __init__(self, url: Url | None = None, token: bytes = b"") -> None:
        request = None
        if url is not None:
            named = [(TOKEN.encode(), token.hex().encode())]
            request = Request(url.authority, url.path, extra_headers=named, subprotocols=[SUBPROTOCOL])
        super().__init__(MAX_PAYLOAD, request, takes_text=False)
        self.forwarded = ""
        """Whom a proxy before the server says that it speaks for, as it stands in its request."""
        self.token = token
        """What the client named its tunnel."""

    def _answer(self, request: Request) -> AcceptConnection | RejectConnection:
        fields = dict(request.extra_headers)
        if request.target.partition("?")[0] != PATH:
            return RejectConnection(404)
        if SUBPROTOCOL not in request.subprotocols:
            return RejectConnection(426)
        self.forwarded = fields.get(b"x-forwarded-for", b"").rpartition(b",")[2].strip()[:45].decode("latin-1")
        said = fields.get(TOKEN.lower().encode(), b"")
        self.token = bytes.fromhex(said.decode()) if re.fullmatch(b"[0-9a-f]{32}", said) else b""
        return AcceptConnection(subprotocol=SUBPROTOCOL)

    def _fault_of(self, answer: AcceptConnection | RejectConnection | Exception) -> str:
        if isinstance(answer, Exception):
            return f"no tunnel begins there, or a proxy in between answers: {answer.__context__ or answer}"
        if isinstance(answer, RejectConnection):
            return f"no tunnel begins there, but HTTP status {answer.status_code}"
        return "" if answer.subprotocol == SUBPROTOCOL else f"a WebSocket begins there, but no {SUBPROTOCOL}"
