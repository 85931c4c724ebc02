"""Channel: one connection to the page, and what it keeps to before anybody is asked; it knows no routes."""

from __future__ import annotations

from twisted.web.server import Request as SiteRequest
from twisted.web.server import Site

from webnode.board import Limits
from webnode.guard import MAX_BODY


class CappedRequest(SiteRequest):
    """A request whose body is never kept beyond ``guard.MAX_BODY``: answered with 413 and cut off."""

    _taken = 0
    _cut = False

    def gotLength(self, length: int | None) -> None:  # noqa: N802
        """Refuse a body that announces itself as too large."""
        super().gotLength(0 if length is not None and length > MAX_BODY else length)
        if length is not None and length > MAX_BODY:
            self._refuse()

    def handleContentChunk(self, data: bytes) -> None:  # noqa: N802
        """Take a piece of the body, or refuse the rest."""
        self._taken += len(data)
        if self._taken > MAX_BODY:
            self._refuse()
        if not self._cut:
            super().handleContentChunk(data)

    def requestReceived(self, command: bytes, path: bytes, version: bytes) -> None:  # noqa: N802
        """Go on, unless the body was refused."""
        if not self._cut:
            super().requestReceived(command, path, version)

    def _refuse(self) -> None:
        if self._cut or self.channel is None:
            return
        self._cut = True
        body = b'{"error": {"field": "body", "problem": "it is too large", "remedy": "send at most 64 KiB"}}'
        head = b"HTTP/1.1 413 Content Too Large\r\nContent-Type: application/json\r\nConnection: close\r\n"
        transport = self.channel.transport
        assert transport is not None
        transport.write(head + b"Content-Length: %d\r\n\r\n" % len(body) + body)
        transport.loseConnection()


def limited(site: Site, limits: Limits) -> None:
    """Have the connections of ``site`` keep to ``limits``; there are none so far but the site's own time-out."""
