"""Websocket: how rosbridge uses one, for both ends; greeting and frames are those of ``standards``.  Pure."""

from __future__ import annotations

from standards.head import Head, head
from standards.websocket import BINARY, CLOSE, KEY, TEXT, End, Nonce, is_switch, is_upgrade, switch

MAX_MESSAGE = 4 * 1024 * 1024
"""Bytes of a message: a compressed picture of 2 megapixels fits, in base64."""


class WebSocket(End):
    """One end of a connection to rosbridge; its messages are JSON."""

    def __init__(self, nonce: Nonce, host: str = "", path: str = "/", is_client: bool = True) -> None:
        super().__init__(nonce, is_client, MAX_MESSAGE, TEXT, BINARY)
        self._host = host
        self._path = path

    def opening(self) -> bytes:
        """What a client says first."""
        return self._request(self._path, self._host)

    def text(self, payload: bytes) -> bytes:
        """A message as one frame."""
        return self._framed(TEXT, payload)

    def _fault_of_answer(self, answer: Head) -> str:
        if not is_switch(answer):
            return f"no rosbridge answers there, but: {answer.said!r}; look at host, port and path"
        if not is_upgrade(answer) or not self._is_accepted(answer):
            return "the answer is not to our greeting; is a proxy in between?"
        return ""

    def _fault_of_request(self, request: Head) -> str:
        key = request.fields.get(KEY, b"")
        if not request.first.startswith(b"GET ") or not is_upgrade(request) or not key:
            self._put(head("HTTP/1.1 400 Bad Request", "Content-Length: 0"))
            return "no WebSocket greeting"
        self._put(switch(key))
        return ""

    def _last_words(self, goodbye: bytes | None) -> bytes:
        return b"" if goodbye is None else self._framed(CLOSE, goodbye[:2])
