"""Selection: the strategy of a task, behind its guard; the one place that decides where a strategy runs."""

from __future__ import annotations

from middleware.consensus.guard import Guard
from middleware.consensus.strategy import BUILT_IN, place_of, strategy_for


def guarded(name: str, dotted: bool = False) -> Guard:
    """The strategy of that name: built-in ones run here, all others in a process of their own with a deadline.

    Raises ``UnknownStrategy`` where there is none of that name.
    """
    place = place_of(name, dotted)
    if place in BUILT_IN.values():
        return Guard(strategy_for(name, dotted))
    from middleware.consensus.worker import Worker  # most nodes never come here

    return Guard(Worker(name, place), twice=True)
