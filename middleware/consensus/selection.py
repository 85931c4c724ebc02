"""Selection: the strategy of a task, behind its guard; the one place that decides where a strategy runs."""

from __future__ import annotations

from middleware.consensus.deployed import Deployed, is_deployed
from middleware.consensus.guard import Guard
from middleware.consensus.strategy import BUILT_IN, place_of, strategy_for
from middleware.errors import UnknownStrategy


class Strategies:
    """The strategies of one node, by name.

    One of somebody else is made once and shared by all tasks and auctions, since it has a process; ``stop`` ends it.
    So what it lost in one task counts in the next (``guard.STRIKES``): each time the whole node stands still, whichever
    task it is.  One that is asked no more is out for as long as the node is here; its next life asks it again.
    """

    def __init__(self) -> None:
        self._foreign: dict[str, Guard] = {}
        self._is_stopped = False

    def named(self, name: str, deployed: Deployed) -> Guard:
        """The strategy of that name; ``deployed`` are those that an operator pushed, of which the newest is taken.

        Raises ``UnknownStrategy`` where there is none, and for one of somebody else once the node has left.
        """
        known = self._foreign.get(name)
        if known is not None:
            return known
        if _runs_here(name):
            return guarded(name, deployed=deployed)
        if self._is_stopped:
            raise UnknownStrategy(f"strategy {name!r} is asked for after its node has left")
        self._foreign[name] = guarded(name)
        return self._foreign[name]

    def stop(self) -> None:
        """End what strategies of others run in; whoever still asks them hears the fallback."""
        self._is_stopped = True
        for guard in self._foreign.values():
            guard.stop()


def guarded(name: str, dotted: bool = False, deployed: Deployed | None = None) -> Guard:
    """The strategy of that name: built-in ones run here, all others in a process of their own with a deadline.

    What an operator deployed has its process already (``middleware.deployment``), and is asked twice.
    Any other one with a process has to be stopped.  Raises ``UnknownStrategy`` if there is none of that name.
    """
    if _runs_here(name, dotted):
        return Guard(strategy_for(name, dotted, deployed), twice=is_deployed(name))
    from middleware.consensus.worker import Worker  # most nodes never come here

    return Guard(Worker(name, place_of(name, dotted)), twice=True)


def _runs_here(name: str, dotted: bool = False) -> bool:
    """Whether no process has to be started for a strategy; raises ``UnknownStrategy``."""
    return is_deployed(name) or place_of(name, dotted) in BUILT_IN.values()
