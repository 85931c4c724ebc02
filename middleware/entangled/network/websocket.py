"""Exchange datagrams as binary WebSocket messages; text messages and messages longer than a datagram are errors."""

from __future__ import annotations

import re

from wsproto.events import AcceptConnection, RejectConnection, Request

from formats.websocket import WebSocketEnd
from middleware.entangled.network.url import PATH, Url

SUBPROTOCOL = "swarm-tunnel-1"
TOKEN_HEADER = "X-Swarm-Tunnel"
"""The header field that identifies the connections of one tunnel: 32 random hexadecimal digits."""
MAX_PAYLOAD_BYTES = 2048
"""The maximum length of a message in bytes; datagrams are shorter."""


class WebSocket(WebSocketEnd):
    """One end of a tunnel connection; the client if ``url`` is given."""

    def __init__(self, url: Url | None = None, token: bytes = b"") -> None:
        request = None
        if url is not None:
            named = [(TOKEN_HEADER.encode(), token.hex().encode())]
            request = Request(url.authority, url.path, extra_headers=named, subprotocols=[SUBPROTOCOL])
        super().__init__(MAX_PAYLOAD_BYTES, request, takes_text=False)
        self.forwarded = ""
        """The last address in the header field ``X-Forwarded-For``; a reverse proxy in front of the server adds it."""
        self.token = token
        """The identifier of the client's tunnel."""

    def _make_response(self, request: Request) -> AcceptConnection | RejectConnection:
        fields = dict(request.extra_headers)
        if request.target.partition("?")[0] != PATH:
            return RejectConnection(404)
        if SUBPROTOCOL not in request.subprotocols:
            return RejectConnection(426)
        self.forwarded = fields.get(b"x-forwarded-for", b"").rpartition(b",")[2].strip()[:45].decode("latin-1")
        token = fields.get(TOKEN_HEADER.lower().encode(), b"")
        self.token = bytes.fromhex(token.decode()) if re.fullmatch(b"[0-9a-f]{32}", token) else b""
        return AcceptConnection(subprotocol=SUBPROTOCOL)

    def _find_error(self, answer: AcceptConnection | RejectConnection | Exception) -> str:
        if isinstance(answer, Exception):
            return f"the server does not serve a tunnel, or a proxy in between answered: {answer.__context__ or answer}"
        if isinstance(answer, RejectConnection):
            return f"the server does not serve a tunnel at this path; it answered with HTTP status {answer.status_code}"
        return (
            ""
            if answer.subprotocol == SUBPROTOCOL
            else f"the server accepts WebSockets, but not the subprotocol {SUBPROTOCOL}"
        )
