"""Tests of ``agents.guarded``: a behaviour of somebody else."""

from __future__ import annotations

import random
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from agents.behaviour import STAND, behaviour_for
from agents.context import Context
from agents.guarded import Guarded
from drivers.reading import Action, Observation
from middleware.errors import UnknownTask
from middleware.tasks import Task

GO = {"base.vx": 0.1}


class Spin:
    """A behaviour that gets dizzy after ``turns`` turns."""

    def __init__(self, parameters: object = None, rng: object = None, turns: int = 2) -> None:
        self.cost: object = 1.5
        self.turns = turns

    def look(self, seen: Observation, now: float) -> None:
        """Look at nothing."""

    def search(self, now: float) -> Action:
        """Go."""
        return GO

    hold = search

    def execute(self, now: float) -> Action | None:
        """Turn, or fall."""
        self.turns -= 1
        return {1: GO, 0: None}[self.turns]


class GuardedTests(SynchronousTestCase):
    def test_asks_while_it_behaves(self) -> None:
        """What the behaviour says is what is done, its end included."""
        guarded = Guarded(Spin(), STAND)
        guarded.look(Observation(0.0, 0.0, {}), 0.0)
        self.assertEqual((guarded.cost, guarded.search(0.0), guarded.hold(0.0)), (1.5, GO, GO))
        self.assertEqual((guarded.execute(Context(0.0)), guarded.execute(Context(0.1))), (GO, None))

    def test_stands_after_it_raised(self) -> None:
        """Once it has raised, the body stands, nothing is reported and it is not asked again; the trace is logged."""
        guarded = Guarded(Spin(turns=9), STAND)
        self.assertEqual(guarded.execute(Context(0.0)), STAND)
        self.assertEqual(len(self.flushLoggedErrors(KeyError)), 1)
        self.assertEqual((guarded.execute(Context(0.1)), guarded.search(0.1), guarded.cost), (STAND, STAND, None))

    def test_what_it_may_have_beside(self) -> None:
        """What a behaviour has beside what it must is asked of it, with the usual value where it has none or raises."""
        spin = Spin()
        spin.value, spin.choice = (1.0,), "left"  # type: ignore[attr-defined]
        guarded: Any = Guarded(spin, STAND)
        self.assertEqual((guarded.value, guarded.choice, guarded.weight, guarded.is_safe), ((1.0,), "left", 1.0, True))
        self.assertFalse(hasattr(guarded, "take_post"))
        guarded.has_failed = True
        self.assertEqual((guarded.value, guarded.choice), ((), ""))

    def test_cost_that_is_no_distance(self) -> None:
        """A cost that is negative, infinite, not a number or none at all is no report."""
        for cost in (-1.0, float("inf"), float("nan"), "near", None):
            spin = Spin()
            spin.cost = cost
            self.assertIsNone(Guarded(spin, STAND).cost)

    def test_behaviour_by_its_deployed_name(self) -> None:
        """A task of the kind ``deployed:x`` gets the deployed behaviour; others are refused with those there are."""
        deployed = {("behaviour", "spin"): Spin, ("strategy", "best"): Spin}
        made = behaviour_for(Task("t", "deployed:spin", ""), random.Random(1), deployed)
        self.assertIsInstance(made, Guarded)
        self.assertEqual(made.cost, 1.5)
        for kind in ("deployed:best", "deployed:other"):
            error = self.assertRaises(UnknownTask, behaviour_for, Task("t", kind, ""), random.Random(1), deployed)
            self.assertIn("there are deployed:spin", str(error))
        self.assertRaises(UnknownTask, behaviour_for, Task("t", "deployed:spin", ""), random.Random(1))
