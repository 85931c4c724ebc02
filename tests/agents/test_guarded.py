"""Tests of ``agents.guarded``: a behaviour in another process."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from agents.behaviour import STAND, behaviour_for
from agents.context import Context
from agents.guarded import FRESH_S, Guarded
from agents.means import Means
from drivers.reading import Action, Frame, Observation
from middleware.consensus.deployed import Make
from middleware.errors import UnknownTask
from middleware.tasks.task import Task
from tests.agents.loopback import Loopback

GO = {"base.vx": 0.1}
SEEN = Observation(1.0, 2.0, {"range.near": 0.5, "bump.left": True}, {"imu.az": (1.0, 2.0)}, Frame(1, 2, 3, b"j", 4.0))


class Spin:
    """A behaviour that gets dizzy after ``turns`` turns."""

    def __init__(self, parameters: object = None, rng: object = None, turns: int = 2) -> None:
        self.cost: object = 1.5
        self.turns = turns
        self.seen: list[tuple[Observation, float]] = []

    def look(self, seen: Observation, now: float) -> None:
        """Keep what is seen."""
        self.seen.append((seen, now))

    def search(self, now: float) -> Action:
        """Go."""
        return GO

    hold = search

    def execute(self, context: Context) -> Action | None:
        """Turn, or fall."""
        self.turns -= 1
        return {1: GO, 0: None}[self.turns]


def guarded(spin: object) -> tuple[Any, Loopback]:
    """A guarded behaviour, and the way to it."""
    way = Loopback(lambda parameters, rng: spin)
    return Guarded(way, STAND), way


class GuardedTests(SynchronousTestCase):
    def test_asks_while_it_behaves(self) -> None:
        """What the behaviour says is what is done, its end included; it sees what the body senses, as it is."""
        spin = Spin()
        behaviour, _ = guarded(spin)
        behaviour.look(SEEN, 0.5)
        self.assertEqual(spin.seen, [(SEEN, 0.5)])
        self.assertEqual((behaviour.cost, behaviour.search(0.0), behaviour.hold(0.0)), (1.5, GO, GO))
        self.assertEqual((behaviour.execute(Context(0.0)), behaviour.execute(Context(0.1))), (GO, None))

    def test_stands_after_it_raised(self) -> None:
        """Once it has raised, the body stands, nothing is reported and it is not asked again."""
        behaviour, way = guarded(Spin(turns=9))
        self.assertEqual(behaviour.execute(Context(0.0)), STAND)
        self.assertTrue(behaviour.has_failed and way.is_closed)
        asked = list(way.asked)
        self.assertEqual((behaviour.execute(Context(0.1)), behaviour.search(0.1), behaviour.cost), (STAND, STAND, None))
        self.assertEqual(way.asked, asked)

    def test_never_waits(self) -> None:
        """While it has not answered the last answer counts for a moment, and then the body stands."""
        behaviour, way = guarded(Spin())
        self.assertEqual(behaviour.search(1.0), GO)
        way.is_held = True
        self.assertEqual(behaviour.search(0.99 + FRESH_S), GO)
        self.assertEqual(behaviour.search(1.01 + FRESH_S), STAND)
        self.assertEqual(way.asked, ["search", "search"])
        way.let()
        self.assertEqual(behaviour.search(1.1 + FRESH_S), GO)

    def test_action_of_another_lease_or_method(self) -> None:
        """What was answered under another token, or to another question, moves nothing."""
        behaviour, way = guarded(Spin(turns=2))
        self.assertEqual(behaviour.execute(Context(0.0, token=4)), GO)
        way.is_held = True
        self.assertEqual(behaviour.execute(Context(0.05, token=5)), STAND)
        self.assertEqual(behaviour.hold(0.06), STAND)

    def test_looks_are_left_out(self) -> None:
        """A behaviour that is slow at looking is shown the next one only after it has answered."""
        spin = Spin()
        behaviour, way = guarded(spin)
        way.is_held = True
        for now in (0.0, 0.1, 0.2):
            behaviour.look(SEEN, now)
        way.let()
        behaviour.look(SEEN, 0.3)
        way.is_behind = True
        way.let()
        behaviour.look(SEEN, 0.4)
        self.assertEqual([now for _, now in spin.seen], [0.0, 0.3])

    def test_hostile_answers(self) -> None:
        """An answer that is no action, no number or no list at all ends the behaviour, and raises nothing."""
        answers: list[object] = [
            None,
            7,
            [],
            [None],
            [{"base.vx": float("nan")}, []],
            [{"base.vx": "fast"}, [None] * 9],
            [{7: 1.0}, [None] * 9],
            [{str(n): 1.0 for n in range(1000)}, [None] * 9],
            ["go", [None] * 9],
        ]
        for answer in answers:
            behaviour, way = guarded(Spin())

            def ask(method: str, arguments: list[Any], take: Callable[[bool, Any], None], a: object = answer) -> bool:
                take(True, a)
                return True

            way.ask = ask  # type: ignore[method-assign]
            self.assertEqual((behaviour.search(0.0), behaviour.has_failed), (STAND, True), answer)

    def test_what_it_may_have_beside(self) -> None:
        """What a behaviour has beside what it must is told, with the usual value where it has none or failed."""
        spin = Spin()
        spin.value, spin.choice = (1.0,), "left"  # type: ignore[attr-defined]
        behaviour, way = guarded(spin)
        self.assertEqual(
            (behaviour.value, behaviour.choice, behaviour.weight, behaviour.is_safe), ((1.0,), "left", 1.0, True)
        )
        self.assertFalse(hasattr(behaviour, "take_post"))
        way.fault = "gone"
        self.assertEqual((behaviour.value, behaviour.choice), ((), ""))

    def test_means_follow(self) -> None:
        """What the body learns of itself reaches the behaviour with the next look."""
        told: list[Means] = []
        spin = Spin()
        spin.embody = told.append  # type: ignore[attr-defined]
        behaviour, way = guarded(spin)
        means = Means()
        behaviour.embody(means)
        means.circle = 0.25
        behaviour.look(SEEN, 0.0)
        behaviour.look(SEEN, 0.1)
        self.assertEqual([each.circle for each in told], [0.25])
        self.assertEqual(way.asked, ["embody", "embody", "look", "look"])

    def test_cost_that_is_no_distance(self) -> None:
        """A cost that is negative, infinite, not a number or none at all is no report."""
        for cost in (-1.0, float("inf"), float("nan"), "near", None, True):
            spin = Spin()
            spin.cost = cost
            self.assertIsNone(guarded(spin)[0].cost)

    def test_behaviour_by_its_deployed_name(self) -> None:
        """A task of the kind ``deployed:x`` gets the deployed behaviour; others are refused with those there are."""
        deployed: dict[tuple[str, str], Make] = {
            ("behaviour", "spin"): Loopback.of(Spin),
            ("strategy", "best"): Spin,
        }
        made = behaviour_for(Task("t", "deployed:spin", ""), random.Random(1), deployed)
        self.assertIsInstance(made, Guarded)
        self.assertEqual(made.cost, 1.5)
        for kind in ("deployed:best", "deployed:other"):
            error = self.assertRaises(UnknownTask, behaviour_for, Task("t", kind, ""), random.Random(1), deployed)
            self.assertIn("deployed: deployed:spin", str(error))
        self.assertRaises(UnknownTask, behaviour_for, Task("t", "deployed:spin", ""), random.Random(1))
