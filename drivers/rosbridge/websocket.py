"""WebSocket connections of rosbridge, for both ends."""

from __future__ import annotations

from wsproto.events import AcceptConnection, RejectConnection, Request

from formats.websocket import WebSocketEnd

MAX_MESSAGE_BYTES = 4 * 1024 * 1024
"""Maximum message in bytes: enough for a compressed picture of 2 megapixels in base64."""


class WebSocket(WebSocketEnd):
    """One end of a connection to rosbridge, the client if ``host`` is given; its messages are JSON."""

    def __init__(self, host: str = "", path: str = "/") -> None:
        super().__init__(MAX_MESSAGE_BYTES, Request(host, path) if host else None)

    def _make_response(self, request: Request) -> AcceptConnection | RejectConnection:
        return AcceptConnection()

    def _find_error(self, answer: AcceptConnection | RejectConnection | Exception) -> str:
        if isinstance(answer, Exception):
            return f"no rosbridge answers there ({answer.__context__ or answer}); check host, port and path"
        if isinstance(answer, RejectConnection):
            return f"no rosbridge answers there, but HTTP status {answer.status_code}; check host, port and path"
        return ""
