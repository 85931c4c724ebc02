"""Fault: a node that can be made to fail, where its settings allow it."""

from __future__ import annotations

from middleware.settings import Settings
from swarmnode.seams import Seams


def faulty(settings: Settings, seams: Seams) -> Seams:
    """The seams through which faults can be caused; unchanged, as none can be caused so far."""
    return seams
