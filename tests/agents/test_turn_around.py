"""Tests of ``agents.turn_around``."""

from __future__ import annotations

import math
import random

from twisted.trial.unittest import SynchronousTestCase

from agents.behaviour import STAND
from agents.context import Context
from agents.motion import MotionCapabilities
from agents.turn_around import TurnAround
from drivers.reading import Description, Observation, Value


def seen(**values: Value) -> Observation:
    """Return an observation; ``odom_yaw`` stands for ``odom.yaw``."""
    return Observation(0.0, 0.0, {key.replace("_", "."): value for key, value in values.items()})


class TurnAroundTests(SynchronousTestCase):
    def test_cost_is_the_charge_used_up(self) -> None:
        """The cost is the used share of the battery charge; without a battery reading there is no cost."""
        turn = TurnAround({}, random.Random(1))
        self.assertIsNone(turn.cost)
        turn.look(seen(odom_yaw=0.0), 0.0)
        self.assertIsNone(turn.cost)
        turn.look(seen(power_level=0.75), 0.0)
        self.assertEqual(turn.cost, 0.25)

    def test_one_turn_and_no_more(self) -> None:
        """The dog turns exactly once, even if the angle wraps; earlier turns do not count."""
        turn = TurnAround({}, random.Random(1))
        yaw = 2.0
        for _ in range(20):
            yaw += 0.3
            turn.look(seen(odom_yaw=math.remainder(yaw, math.tau)), 0.0)
        start = yaw
        while (action := turn.execute(Context(0.0, is_resumed=True))) is not None:
            self.assertGreater(action["base.wz"], 0.0)
            yaw += 0.05
            turn.look(seen(odom_yaw=math.remainder(yaw, math.tau)), 0.0)
        self.assertLess(abs(yaw - start - math.tau), 0.11)

    def test_turns_can_be_chosen(self) -> None:
        """The parameter ``turns`` sets the number of turns, and an invalid number is refused."""
        turn = TurnAround({"turns": 0.5}, random.Random(1))
        turn.execute(Context(0.0, is_resumed=True))
        for step in range(33):
            turn.look(seen(odom_yaw=step * 0.1), 0.0)
        self.assertIsNone(turn.execute(Context(0.0, is_resumed=True)))
        for wrong in (-1.0, math.inf, math.nan, 1e9, "often"):
            self.assertRaises(ValueError, TurnAround, {"turns": wrong}, random.Random(1))

    def test_body_turns_as_fast_as_it_can(self) -> None:
        """A robot that turns more slowly than a dog gets its maximum turn velocity."""
        turn = TurnAround({}, random.Random(1))
        limits = {"base.vx": (-0.1, 0.1), "base.wz": (-0.5, 0.5)}
        turn.embody(MotionCapabilities(Description("slow", "", {}, limits, 0.1)))
        turn.look(seen(odom_yaw=0.0), 0.0)
        self.assertEqual(turn.execute(Context(0.0, is_resumed=True)), {**STAND, "base.wz": 0.5})
