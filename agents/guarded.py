"""Guarded: a behaviour of somebody else, which may raise without harm to the agent.

Once it has raised it is asked no more: the body stands, and there is no cost to report, so that another goes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from twisted.logger import Logger

from agents.context import Context
from agents.means import Means
from drivers.reading import Action, Observation

T = TypeVar("T")
OPTIONAL: dict[str, object] = {
    "is_safe": True,
    "progress": None,
    "valid_for": 0.0,
    "angle": None,
    "value": (),
    "choice": "",
    "weight": 1.0,
    "electorate": 0.0,
}
"""What a behaviour may have beside what it must, and what holds where it has none (``agents.behaviour``)."""


class Guarded:
    """The behaviour ``inner`` for as long as it does not raise, and ``stand`` from then on."""

    _log = Logger()

    def __init__(self, inner: Any, stand: Action) -> None:
        self._inner = inner
        self._stand = stand
        self.has_failed = False

    def embody(self, means: Means) -> None:
        """Tell it what its body can do, where it wants to know."""
        self._asked(lambda: getattr(self._inner, "embody", lambda _: None)(means), None)

    def look(self, seen: Observation, now: float) -> None:
        """Take in what the body senses now."""
        self._asked(lambda: self._inner.look(seen, now), None)

    @property
    def cost(self) -> float | None:
        """What doing the task would cost this body; None where it cannot tell, or has failed."""
        cost = self._asked(lambda: self._inner.cost, None)
        return cost if isinstance(cost, int | float) and 0 <= cost < float("inf") else None

    def search(self, now: float) -> Action:
        """What to do to be able to tell."""
        return self._asked(lambda: self._inner.search(now), self._stand)

    def hold(self, now: float) -> Action:
        """What to do while another acts."""
        return self._asked(lambda: self._inner.hold(now), self._stand)

    def execute(self, context: Context) -> Action | None:
        """What to do next to get it done; None when it is done."""
        return self._asked(lambda: self._inner.execute(context), self._stand)

    def __getattr__(self, name: str) -> object:
        """What it may have beside; ``AttributeError`` for anything else."""
        if name not in OPTIONAL:
            raise AttributeError(name)
        usual = OPTIONAL[name]
        return self._asked(lambda: getattr(self._inner, name, usual), usual)

    def _asked(self, ask: Callable[[], T], otherwise: T) -> T:
        if self.has_failed:
            return otherwise
        try:
            return ask()
        except Exception:  # a module of somebody else may fail in any way
            self.has_failed = True
            self._log.failure("a deployed behaviour raised; the body stands from now on")
            return otherwise
