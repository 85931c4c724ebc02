"""Fallback: the other web nodes of the team."""

from __future__ import annotations

from webnode.board import Fallbacks, MemoryFallbacks
from webnode.ground import Ground


def fallbacks(ground: Ground) -> Fallbacks:
    """The web nodes of the team; each stands alone so far, and lets in its own page only."""
    return MemoryFallbacks()
