"""Subscribers: those who are told of each new thing, in the order in which they came; none harms another."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from twisted.logger import Logger

T = TypeVar("T")


class Subscribers(Generic[T]):
    """The subscribers of ``robot``; what one of them raises goes to ``log``."""

    def __init__(self, robot: str, log: Logger) -> None:
        self._robot = robot
        self._log = log
        self._all: list[Callable[[T], None]] = []

    def add(self, seen: Callable[[T], None]) -> Callable[[], None]:
        """Call ``seen`` at each new thing; call what is returned to end that."""
        self._all.append(seen)

        def end() -> None:
            if seen in self._all:
                self._all.remove(seen)

        return end

    def tell(self, newest: T) -> None:
        """Call those who are there now; who comes or goes meanwhile changes nothing of this round."""
        for seen in list(self._all):
            try:
                seen(newest)
            except Exception:
                self._log.failure("a subscriber of {robot} failed", robot=self._robot)
