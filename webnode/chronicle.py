"""Chronicle: what happened in the team."""

from __future__ import annotations

from webnode.board import Chronicle, MemoryChronicle
from webnode.ground import Ground


def chronicle(ground: Ground) -> Chronicle:
    """What this node saw; nobody writes it down so far."""
    return MemoryChronicle()
