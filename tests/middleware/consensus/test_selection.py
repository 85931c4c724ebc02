"""Tests of ``middleware.consensus.selection``, as far as they need no process; those are in ``tests.live``."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.deployed import Make
from middleware.consensus.selection import Strategies
from middleware.consensus.strategies.cbba import Cbba
from middleware.consensus.strategies.nearest import Nearest
from middleware.errors import UnknownStrategy


class StrategiesTests(SynchronousTestCase):
    def test_built_in(self) -> None:
        """A built-in strategy is made anew for each task, also when its node has left; an unknown name is an error."""
        strategies = Strategies()
        first, second = strategies.named("nearest", {}), strategies.named("nearest", {})
        self.assertIsInstance(first.strategy, Nearest)
        self.assertIsNot(first, second)
        strategies.stop()
        self.assertIsInstance(strategies.named("cbba", {}).strategy, Cbba)
        self.assertRaises(UnknownStrategy, strategies.named, "farthest", {})

    def test_deployed(self) -> None:
        """Each task gets the version that was deployed last; who had the one before keeps it."""
        deployed: dict[tuple[str, str], Make] = {("strategy", "best"): Nearest}
        strategies = Strategies()
        before = strategies.named("deployed:best", deployed)
        deployed["strategy", "best"] = Cbba
        self.assertIsInstance(strategies.named("deployed:best", deployed).strategy, Cbba)
        self.assertIsInstance(before.strategy, Nearest)
        self.assertRaises(UnknownStrategy, strategies.named, "deployed:best", {})
