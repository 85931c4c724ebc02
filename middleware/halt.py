"""Halt: whether the whole team is to stand."""

from __future__ import annotations

from collections.abc import Callable

from middleware.entangled.node import EntangledNode


class Halt:
    """Whether the team is halted; what acts asks ``is_on`` before it does, and is told of each change."""

    is_on = False

    def watch(self, changed: Callable[[], None]) -> None:
        """Call ``changed`` when the team is halted and when it is released."""


def answer_halt(entangled: EntangledNode) -> Halt:
    """The halt as this node knows it; nobody halts a team so far."""
    return Halt()
