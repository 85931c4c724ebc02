"""Invite: where others find the page, and that as a code which a phone's camera reads."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable
from typing import Any
from urllib.parse import urlsplit

from twisted.internet.defer import Deferred
from twisted.internet.threads import deferToThreadPool

from webnode.fallback import is_loopback

MARGIN = 4
"""Modules of white around a code; scanners want them."""


def code(text: str) -> str:
    """A QR code of ``text`` as an SVG, black on nothing; empty where there is no text or no library to draw it with."""
    try:
        import segno
    except ModuleNotFoundError:
        return ""
    if not text:
        return ""
    drawing = io.BytesIO()
    made = segno.make(text, micro=False, error="m", boost_error=False)
    looks: dict[str, Any] = {"svgclass": None, "lineclass": None, "omitsize": True, "xmldecl": False, "nl": False}
    made.save(drawing, kind="svg", border=MARGIN, **looks)
    return drawing.getvalue().decode()


def best_first(urls: Iterable[str]) -> list[str]:
    """``urls`` in the order in which to offer them: those that others can reach first, then those over TLS."""

    def rank(url: str) -> tuple[bool, bool]:
        return is_loopback(urlsplit(url).hostname or ""), not url.startswith("https:")

    return sorted(dict.fromkeys(urls), key=rank)


class TeamInvites:
    """Where the page of this node is; ``urls`` says it as it is now, ``authority`` is empty where there is no TLS."""

    def __init__(
        self, urls: Callable[[], Iterable[str]], authority: bytes, fingerprint: str, reactor: Any, pool: Any
    ) -> None:
        self.authority = authority
        self.fingerprint = fingerprint
        self._urls = urls
        self._reactor = reactor
        self._pool = pool

    def urls(self) -> list[str]:
        """Where this node serves the page, the best for others first."""
        return best_first(self._urls())

    def drawn(self, text: str) -> Deferred[str]:
        """A QR code, drawn beside the reactor's thread: a small device takes a tenth of a second for it."""
        return deferToThreadPool(self._reactor, self._pool, code, text)
