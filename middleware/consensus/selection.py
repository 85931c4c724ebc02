"""Select the strategy of a task and the process in which it runs."""

from __future__ import annotations

from middleware.consensus.deployed import Deployed, is_deployed
from middleware.consensus.guard import Guard
from middleware.consensus.strategy import BUILT_IN, place_of, strategy_for
from middleware.errors import UnknownStrategy


class Strategies:
    """The strategies of one node, by name.

    A third-party strategy runs in a process, so one instance is shared by all tasks and auctions until ``stop``.  Its
    losses (``guard.STRIKES``) therefore count across tasks: each loss blocks the whole node.  A strategy that reached
    the limit is not called again until the node restarts.
    """

    def __init__(self) -> None:
        self._third_party: dict[str, Guard] = {}
        self._is_stopped = False

    def named(self, name: str, deployed: Deployed) -> Guard:
        """Return the guarded strategy of that name; the newest one if it is in ``deployed``.

        Raises ``UnknownStrategy`` for an unknown name, and for a third-party strategy after ``stop``.
        """
        known = self._third_party.get(name)
        if known is not None:
            return known
        if _runs_here(name):
            return guarded(name, deployed=deployed)
        if self._is_stopped:
            raise UnknownStrategy(f"strategy {name!r} cannot be loaded: the node has stopped")
        self._third_party[name] = guarded(name)
        return self._third_party[name]

    def stop(self) -> None:
        """Stop the processes of third-party strategies; later calls get the fallback's result."""
        self._is_stopped = True
        for guard in self._third_party.values():
            guard.stop()


def guarded(name: str, dotted: bool = False, deployed: Deployed | None = None) -> Guard:
    """Load and guard a strategy: built-in ones run in this process, all others in their own process with a deadline.

    A deployed strategy already has a process (``middleware.deployment``), and is called twice.  The caller stops any
    other strategy with a process.  Raises ``UnknownStrategy``.
    """
    if _runs_here(name, dotted):
        return Guard(strategy_for(name, dotted, deployed), twice=is_deployed(name))
    from middleware.consensus.worker import Worker  # rarely needed

    return Guard(Worker(name, place_of(name, dotted)), twice=True)


def _runs_here(name: str, dotted: bool = False) -> bool:
    """Return whether a strategy needs no new process; raises ``UnknownStrategy``."""
    return is_deployed(name) or place_of(name, dotted) in BUILT_IN.values()
