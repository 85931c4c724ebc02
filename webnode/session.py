"""Session: who has signed in to the page."""

from __future__ import annotations

from webnode.board import OpenSessions, Sessions
from webnode.ground import Ground


def sessions(ground: Ground) -> Sessions:
    """Who may come in; there is no sign-in so far, so whoever can open the page is an operator."""
    return OpenSessions()
