"""Tests of strategies from other Python packages, each in its own real process."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.assignment import Item
from middleware.consensus.guarded_strategy import MAX_LOSSES, GuardedStrategy
from middleware.consensus.process_strategy import DEADLINE_S, ProcessStrategy
from middleware.consensus.strategies.cbba import Cbba
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Consensus, Report
from middleware.consensus.strategy_registry import load_guarded_strategy

ROOT = str(Path(__file__).resolve().parents[2])
TEAM = [Report("a", 3.0, value=(1.0, 2.0)), Report("b", 1.0), Report("c", 2.0)]
PATIENCE = 20.0
"""The timeout of waits, and the deadline of strategies that must reply; it is long because of loaded machines."""


class Good(Nearest):
    name = "good"


class Many(Cbba):
    name = "many"


class Looping(Nearest):
    name = "looping"

    def find(self, contacts: Sequence[Report]) -> Consensus:
        while True:
            pass


class Giant(Nearest):
    name = "giant"

    def find(self, contacts: Sequence[Report]) -> Consensus:
        return Consensus("b", reason="x" * 1_000_000)


class Hungry(Nearest):
    name = "hungry"

    def find(self, contacts: Sequence[Report]) -> Consensus:
        return Consensus("b", reason=str(len([0] * 10**10)))


class Quitting(Nearest):
    name = "quitting"

    def find(self, contacts: Sequence[Report]) -> Consensus:
        os._exit(0)


class Chatty(Nearest):
    name = "chatty"

    def find(self, contacts: Sequence[Report]) -> Consensus:
        sys.stdout.write("\x00\x00 nearly an answer\n")
        sys.stdout.flush()
        return super().find(contacts)


class Raising(Nearest):
    name = "raising"

    def find(self, contacts: Sequence[Report]) -> Consensus:
        raise ZeroDivisionError("I divide")


class ProcessStrategyTests(SynchronousTestCase):
    def guard(self, name: str, deadline: float = PATIENCE) -> GuardedStrategy:
        """Return a guard around a class of this module, which is loaded in a child process."""
        worker = ProcessStrategy(name, f"{__name__}:{name}", deadline, path=(ROOT,))
        self.addCleanup(worker.stop)
        guard = GuardedStrategy(worker, twice=True)
        self.loaded(guard)
        return guard

    def loaded(self, guard: GuardedStrategy) -> Consensus:
        """Return the result as soon as the process has loaded the strategy."""
        end = time.monotonic() + PATIENCE
        while "still loading" in (found := guard.find(TEAM)).reason and time.monotonic() < end:
            pass
        self.flushLoggedErrors()
        return found

    def test_good_one(self) -> None:
        """A strategy in another process gives the same results as in this process."""
        guard = self.guard("Good")
        self.assertEqual(guard.find(TEAM), Nearest().find(TEAM))
        self.assertEqual(guard.find(TEAM).strategy, "Good")
        self.assertTrue(guard.improves(TEAM[0], TEAM[1], 0.1))
        self.assertEqual(guard.merge(TEAM, TEAM), Nearest().merge(TEAM, ()))
        self.assertEqual(self.flushLoggedErrors(), [])

    def test_group(self) -> None:
        """A strategy for groups of tasks gives the same results in a separate process.

        A strategy for single tasks is called once per task.
        """
        items = [Item("s", (1.0, 2.0)), Item("t")]
        bids = [Report(a, c, task=t) for a, c in (("a", 1.0), ("b", 2.0)) for t in "st"]
        self.assertEqual(self.guard("Many").find_group(bids, items), Cbba().find_group(bids, items))
        self.assertEqual([p.assigned_agent for p in self.guard("Good").find_group(bids, items)], ["a", "b"])
        self.assertEqual(self.flushLoggedErrors(), [])

    def test_looping(self) -> None:
        """After a strategy has missed its deadline three times, it is no longer called, and its process ends."""
        guard = self.guard("Looping", DEADLINE_S)
        worst = 0.0
        end = time.monotonic() + PATIENCE
        while "not called again" not in guard.find(TEAM).reason and time.monotonic() < end:
            began = time.monotonic()
            self.assertEqual(guard.find(TEAM).assigned_agent, "b")
            worst = max(worst, time.monotonic() - began)
        self.assertIn(f"no result {MAX_LOSSES} times", guard.find(TEAM).reason)
        self.assertLess(worst, PATIENCE / MAX_LOSSES)
        self.assertIsNone(guard.strategy._process)  # type: ignore[attr-defined]
        self.flushLoggedErrors()

    def test_others(self) -> None:
        """A strategy is skipped if its reply is too large, it needs too much memory, its process died or it raises."""
        for name, why in (
            ("Giant", "bytes; at most"),
            ("Hungry", "MemoryError"),
            ("Quitting", "the process of the strategy has ended"),
            ("Raising", "ZeroDivisionError: I divide"),
            ("Absent", "has no attribute 'Absent'"),
        ):
            found = self.loaded(self.guard(name))
            self.assertEqual((found.assigned_agent, found.strategy), ("b", "nearest"), name)
            self.assertIn(why, found.reason)

    def test_chatty(self) -> None:
        """Text that a strategy prints is not read as its reply."""
        self.assertEqual(self.guard("Chatty").find(TEAM), Nearest().find(TEAM))

    def test_stopped(self) -> None:
        """A stopped strategy is skipped and starts no process.

        After the death of a process the next call starts another.
        """
        guard = self.guard("Good")
        worker = guard.strategy
        assert isinstance(worker, ProcessStrategy) and worker._process is not None
        lost = worker._process
        lost.kill()
        lost.wait()
        self.assertIn("the process of the strategy has ended", guard.find(TEAM).reason)
        self.assertEqual(self.loaded(guard).strategy, "Good")
        guard.stop()
        found = guard.find(TEAM)
        self.assertEqual((found.assigned_agent, found.strategy), ("b", "nearest"))
        self.assertIn("the strategy was stopped", found.reason)
        self.assertIsNone(worker._process)
        self.flushLoggedErrors()

    def test_foreign_by_name(self) -> None:
        """A strategy identified by module and class runs in a separate process."""
        guard = load_guarded_strategy(f"{__name__}:Good", dotted=True)
        self.addCleanup(guard.stop)
        self.assertIsInstance(guard.strategy, ProcessStrategy)
