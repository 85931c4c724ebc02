"""Load the strategy of a task, and select the process in which it runs."""

from __future__ import annotations

from middleware.consensus.deployed_modules import DeployedModules, is_deployed
from middleware.consensus.guarded_strategy import GuardedStrategy
from middleware.consensus.strategy import BUILT_IN, find_import_path, load_strategy
from middleware.errors import UnknownStrategy


class StrategyRegistry:
    """The strategies of one node, by name.

    A third-party strategy runs in a separate process, so all tasks and auctions share one instance until ``stop``.  Its
    failed calls (limit: ``guarded_strategy.MAX_LOSSES``) are counted over all tasks, because each of them blocks the
    whole node.  A strategy that has reached the limit is not called again until the node restarts.
    """

    def __init__(self) -> None:
        self._third_party: dict[str, GuardedStrategy] = {}
        self._is_stopped = False

    def get(self, name: str, deployed: DeployedModules) -> GuardedStrategy:
        """Return the guarded strategy with that name; for a deployed strategy, its newest version.

        Raises ``UnknownStrategy`` for an unknown name, and for a third-party strategy after ``stop``.
        """
        known = self._third_party.get(name)
        if known is not None:
            return known
        if _is_run_in_process(name):
            return load_guarded_strategy(name, deployed=deployed)
        if self._is_stopped:
            raise UnknownStrategy(f"strategy {name!r} cannot be loaded: the node has stopped")
        self._third_party[name] = load_guarded_strategy(name)
        return self._third_party[name]

    def stop(self) -> None:
        """Stop the processes of third-party strategies; later calls return the result of the fallback."""
        self._is_stopped = True
        for strategy in self._third_party.values():
            strategy.stop()


def load_guarded_strategy(name: str, dotted: bool = False, deployed: DeployedModules | None = None) -> GuardedStrategy:
    """Load and guard a strategy: a built-in one runs in this process, any other in a separate process with a deadline.

    A deployed strategy already has a process (``middleware.deployment``).  The caller has to stop any other strategy
    that has a process.  Raises ``UnknownStrategy``.
    """
    if _is_run_in_process(name, dotted):
        return GuardedStrategy(load_strategy(name, dotted, deployed), twice=is_deployed(name))
    from middleware.consensus.process_strategy import ProcessStrategy  # rarely needed

    return GuardedStrategy(ProcessStrategy(name, find_import_path(name, dotted)), twice=True)


def _is_run_in_process(name: str, dotted: bool = False) -> bool:
    """Return whether a strategy can be loaded without a new process; raise ``UnknownStrategy``."""
    return is_deployed(name) or find_import_path(name, dotted) in BUILT_IN.values()
