"""Tests of ``agents.behaviour_proxy``: a behaviour that runs in another process."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from agents.behaviour import STAND, create_behaviour
from agents.behaviour_proxy import ACTION_TTL_S, BehaviourProxy
from agents.context import Context
from agents.motion import MotionCapabilities
from drivers.reading import Action, Frame, Observation
from middleware.consensus.deployed_modules import Factory
from middleware.errors import UnknownTask
from middleware.tasks.task import Task
from tests.agents.loopback import Loopback

GO = {"base.vx": 0.1}
SEEN = Observation(1.0, 2.0, {"range.near": 0.5, "bump.left": True}, {"imu.az": (1.0, 2.0)}, Frame(1, 2, 3, b"j", 4.0))


class Spin:
    """A behaviour that ends after ``turns`` turns, and raises an exception in all except the last two."""

    def __init__(self, parameters: object = None, rng: object = None, turns: int = 2) -> None:
        self.cost: object = 1.5
        self.turns = turns
        self.seen: list[tuple[Observation, float]] = []

    def look(self, seen: Observation, now: float) -> None:
        """Record the observation."""
        self.seen.append((seen, now))

    def search(self, now: float) -> Action:
        """Return the action."""
        return GO

    hold = search

    def execute(self, context: Context) -> Action | None:
        """Return an action in the second to last turn, None in the last turn; raise KeyError in all earlier turns."""
        self.turns -= 1
        return {1: GO, 0: None}[self.turns]


def guarded(spin: object) -> tuple[Any, Loopback]:
    """Return the proxy of a behaviour, and its connection to that behaviour."""
    connection = Loopback(lambda parameters, rng: spin)
    return BehaviourProxy(connection, STAND), connection


class BehaviourProxyTests(SynchronousTestCase):
    def test_asks_while_it_behaves(self) -> None:
        """Observations reach the behaviour unchanged; its actions and its end (None) reach the agent unchanged."""
        spin = Spin()
        behaviour, _ = guarded(spin)
        behaviour.look(SEEN, 0.5)
        self.assertEqual(spin.seen, [(SEEN, 0.5)])
        self.assertEqual((behaviour.cost, behaviour.search(0.0), behaviour.hold(0.0)), (1.5, GO, GO))
        self.assertEqual((behaviour.execute(Context(0.0)), behaviour.execute(Context(0.1))), (GO, None))

    def test_stands_after_it_raised(self) -> None:
        """After an exception the robot stands still, the cost is None, and the behaviour is not called again."""
        behaviour, connection = guarded(Spin(turns=9))
        self.assertEqual(behaviour.execute(Context(0.0)), STAND)
        self.assertTrue(behaviour.has_failed and connection.is_closed)
        asked = list(connection.asked)
        self.assertEqual((behaviour.execute(Context(0.1)), behaviour.search(0.1), behaviour.cost), (STAND, STAND, None))
        self.assertEqual(connection.asked, asked)

    def test_never_waits(self) -> None:
        """Until a reply arrives, the previous action stays valid for at most ``ACTION_TTL_S`` seconds.

        Then the robot stands.
        """
        behaviour, connection = guarded(Spin())
        self.assertEqual(behaviour.search(1.0), GO)
        connection.is_held = True
        self.assertEqual(behaviour.search(0.99 + ACTION_TTL_S), GO)
        self.assertEqual(behaviour.search(1.01 + ACTION_TTL_S), STAND)
        self.assertEqual(connection.asked, ["search", "search"])
        connection.let()
        self.assertEqual(behaviour.search(1.1 + ACTION_TTL_S), GO)

    def test_action_of_another_lease_or_method(self) -> None:
        """The robot does not move on a late reply to a call with a different token or to a different method."""
        behaviour, connection = guarded(Spin(turns=2))
        self.assertEqual(behaviour.execute(Context(0.0, token=4)), GO)
        connection.is_held = True
        self.assertEqual(behaviour.execute(Context(0.05, token=5)), STAND)
        self.assertEqual(behaviour.hold(0.06), STAND)

    def test_looks_are_left_out(self) -> None:
        """A slow behaviour receives the next observation only after it has replied to the previous one."""
        spin = Spin()
        behaviour, connection = guarded(spin)
        connection.is_held = True
        for now in (0.0, 0.1, 0.2):
            behaviour.look(SEEN, now)
        connection.let()
        behaviour.look(SEEN, 0.3)
        connection.has_unsent = True
        connection.let()
        behaviour.look(SEEN, 0.4)
        self.assertEqual([now for _, now in spin.seen], [0.0, 0.3])

    def test_hostile_answers(self) -> None:
        """A reply with an invalid type or value ends the behaviour and raises no exception."""
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
            behaviour, connection = guarded(Spin())

            def ask(method: str, arguments: list[Any], take: Callable[[bool, Any], None], a: object = answer) -> bool:
                take(True, a)
                return True

            connection.send_request = ask  # type: ignore[method-assign]
            self.assertEqual((behaviour.search(0.0), behaviour.has_failed), (STAND, True), answer)

    def test_what_it_may_have_beside(self) -> None:
        """The proxy passes on the optional attributes of a behaviour.

        If an attribute is missing or raises an exception, the proxy returns the default value of the attribute.
        """
        spin = Spin()
        spin.value, spin.choice = (1.0,), "left"  # type: ignore[attr-defined]
        behaviour, connection = guarded(spin)
        self.assertEqual(
            (behaviour.value, behaviour.choice, behaviour.weight, behaviour.is_safe), ((1.0,), "left", 1.0, True)
        )
        self.assertFalse(hasattr(behaviour, "take_post"))
        connection.fault = "gone"
        self.assertEqual((behaviour.value, behaviour.choice), ((), ""))

    def test_means_follow(self) -> None:
        """Changed motion capabilities reach the behaviour before the next observation does."""
        received: list[MotionCapabilities] = []
        spin = Spin()
        spin.embody = received.append  # type: ignore[attr-defined]
        behaviour, connection = guarded(spin)
        motion = MotionCapabilities()
        behaviour.embody(motion)
        motion.circle = 0.25
        behaviour.look(SEEN, 0.0)
        behaviour.look(SEEN, 0.1)
        self.assertEqual([each.circle for each in received], [0.25])
        self.assertEqual(connection.asked, ["embody", "embody", "look", "look"])

    def test_cost_that_is_no_distance(self) -> None:
        """A cost that is negative, infinite, NaN or not a number becomes None."""
        for cost in (-1.0, float("inf"), float("nan"), "near", None, True):
            spin = Spin()
            spin.cost = cost
            self.assertIsNone(guarded(spin)[0].cost)

    def test_behaviour_by_its_deployed_name(self) -> None:
        """The kind ``deployed:x`` selects the deployed behaviour ``x``.

        The error for an unknown name lists the known names.
        """
        deployed: dict[tuple[str, str], Factory] = {
            ("behaviour", "spin"): Loopback.of(Spin),
            ("strategy", "best"): Spin,
        }
        made = create_behaviour(Task("t", "deployed:spin", ""), random.Random(1), deployed)
        self.assertIsInstance(made, BehaviourProxy)
        self.assertEqual(made.cost, 1.5)
        for kind in ("deployed:best", "deployed:other"):
            error = self.assertRaises(UnknownTask, create_behaviour, Task("t", kind, ""), random.Random(1), deployed)
            self.assertIn("deployed: deployed:spin", str(error))
        self.assertRaises(UnknownTask, create_behaviour, Task("t", "deployed:spin", ""), random.Random(1))
