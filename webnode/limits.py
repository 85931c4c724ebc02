"""Limits: how much one address may have open at once."""

from __future__ import annotations

from webnode.board import Limits, NoLimits
from webnode.ground import Ground


def limits(ground: Ground) -> Limits:
    """What the connections of the page keep to; there are no limits for one address so far."""
    return NoLimits()
