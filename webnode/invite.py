"""List the URLs of this node's page for invitations, and draw them as QR codes."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable
from typing import Any
from urllib.parse import urlsplit

from twisted.internet.defer import Deferred
from twisted.internet.threads import deferToThreadPool

from webnode.failover import is_loopback

MARGIN = 4
"""Width of the quiet zone around a QR code, in modules."""


def make_qr_code(text: str) -> str:
    """Return a QR code of ``text`` as SVG; empty for an empty text or without the library segno."""
    try:
        import segno
    except ModuleNotFoundError:
        return ""
    if not text:
        return ""
    drawing = io.BytesIO()
    qr_code = segno.make(text, micro=False, error="m", boost_error=False)
    options: dict[str, Any] = {"svgclass": None, "lineclass": None, "omitsize": True, "xmldecl": False, "nl": False}
    qr_code.save(drawing, kind="svg", border=MARGIN, **options)
    return drawing.getvalue().decode()


def sort_by_reach(urls: Iterable[str]) -> list[str]:
    """Sort ``urls`` for an invitation: URLs that other machines can reach first, then those over TLS."""

    def rank(url: str) -> tuple[bool, bool]:
        return is_loopback(urlsplit(url).hostname or ""), not url.startswith("https:")

    return sorted(dict.fromkeys(urls), key=rank)


class Invites:
    """The URLs of this node's page, evaluated at each call of ``urls``; ``authority`` is empty without TLS."""

    def __init__(
        self, urls: Callable[[], Iterable[str]], authority: bytes, fingerprint: str, reactor: Any, pool: Any
    ) -> None:
        self.authority = authority
        self.fingerprint = fingerprint
        self._urls = urls
        self._reactor = reactor
        self._pool = pool

    def urls(self) -> list[str]:
        """Return the URLs at which this node serves the page, the most reachable first."""
        return sort_by_reach(self._urls())

    def draw_qr_code(self, text: str) -> Deferred[str]:
        """Draw a QR code on a worker thread, because this takes a small device a tenth of a second."""
        return deferToThreadPool(self._reactor, self._pool, make_qr_code, text)
