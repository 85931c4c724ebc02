"""Selection: the strategy of a task, behind its guard; the one place that decides where a strategy runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from middleware.consensus.guard import Guard
from middleware.consensus.strategy import BUILT_IN, place_of, strategy_for


def guarded(
    name: str, dotted: bool = False, deployed: Mapping[tuple[str, str], Callable[..., Any]] | None = None
) -> Guard:
    """The strategy of that name: built-in ones run here, all others in a process of their own with a deadline.

    What an operator deployed was checked when it came: it runs here, unbounded from then on, and is asked twice.
    Raises ``UnknownStrategy`` where there is none of that name.
    """
    if name.startswith("deployed:"):
        return Guard(strategy_for(name, deployed=deployed), twice=True)
    place = place_of(name, dotted)
    if place in BUILT_IN.values():
        return Guard(strategy_for(name, dotted))
    from middleware.consensus.worker import Worker  # most nodes never come here

    return Guard(Worker(name, place), twice=True)
