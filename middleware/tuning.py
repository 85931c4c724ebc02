"""Tuning: the settings of a node that can be changed while it runs."""

from __future__ import annotations

from middleware.node import SwarmNode
from middleware.settings import Settings


def answer_tuning(node: SwarmNode, settings: Settings) -> None:
    """Have ``node`` tell and change what of ``settings`` can be changed, which is nothing so far."""
