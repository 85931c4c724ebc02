"""Tuner: the settings of devices that can be changed while they run."""

from __future__ import annotations

from webnode.board import Tuning
from webnode.ground import Ground


def tuning(ground: Ground) -> Tuning | None:
    """The tuner of this node; None, as nothing can be changed so far."""
    return None
