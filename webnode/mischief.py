"""Mischief: faults that are caused on purpose."""

from __future__ import annotations

from webnode.board import Faults
from webnode.ground import Ground


def faults(ground: Ground) -> Faults | None:
    """The faults that this node can cause; None, as it can cause none so far."""
    return None
