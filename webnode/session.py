"""Session: who has signed in to the page."""

from __future__ import annotations

from twisted.logger import Logger

from webnode.board import OpenSessions, Sessions
from webnode.ground import Ground

_log = Logger()


def sessions(ground: Ground) -> Sessions:
    """Who may come in; there is no sign-in so far, so whoever can open the page is an operator."""
    if ground.settings.web.code or ground.settings.web.password:
        _log.warn("[web] code and password keep nobody out: whoever can open the page is an operator")
    return OpenSessions()
