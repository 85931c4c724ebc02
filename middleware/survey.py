"""Survey: what a node answers when it is asked what it stores and whom it knows."""

from __future__ import annotations

from middleware.node import SwarmNode


def answer_survey(node: SwarmNode) -> None:
    """Have ``node`` answer; there is nothing that it could be asked so far."""
