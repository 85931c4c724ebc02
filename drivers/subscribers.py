"""Call subscribers in order of subscription; an error in one subscriber does not affect the others."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from twisted.logger import Logger

T = TypeVar("T")


class Subscribers(Generic[T]):
    """The subscribers of ``robot``; their exceptions are logged to ``log``."""

    def __init__(self, robot: str, log: Logger) -> None:
        self._robot = robot
        self._log = log
        self._callbacks: list[Callable[[T], None]] = []

    def add(self, callback: Callable[[T], None]) -> Callable[[], None]:
        """Call ``callback`` with each new item; return a function that ends the subscription."""
        self._callbacks.append(callback)

        def end() -> None:
            if callback in self._callbacks:
                self._callbacks.remove(callback)

        return end

    def notify(self, newest: T) -> None:
        """Call the current subscribers; a subscription that changes during the calls affects only the next item."""
        for callback in list(self._callbacks):
            try:
                callback(newest)
            except Exception:
                self._log.failure("a subscriber of {robot} failed", robot=self._robot)
