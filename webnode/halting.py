"""Halting: the button that stops the whole team."""

from __future__ import annotations

from webnode.board import Halts
from webnode.ground import Ground


def halts(ground: Ground) -> Halts | None:
    """The button of this node; None, as there is none so far."""
    return None
