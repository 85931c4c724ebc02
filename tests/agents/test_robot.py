"""Tests of ``agents.robot``: the actions that reach a robot, and the capabilities learned from their execution."""

from __future__ import annotations

from typing import cast

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from agents.engagement import RobotCommand
from agents.motion import STAND
from agents.robot import AgentRobot
from drivers.driver import Driver, Permit
from drivers.reading import Action
from tests.agents.roamer import described, quantised


class Robot:
    """A driver stub with the description of a Bittle, and the methods that move a robot."""

    def __init__(self) -> None:
        self.description = described("bittle")
        self.state = "ready"
        self.asked: list[Action] = []

    def act(self, action: Action, permit: Permit) -> Action:
        """Execute the nearest gait."""
        self.asked.append(action)
        return quantised(self.description)(action)


class RobotTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.robot = Robot()
        self.body = AgentRobot(cast(Driver, self.robot), Clock(), lambda seen: None, lambda why: None)

    def do(self, **wished: float) -> None:
        """Command these velocities; the velocities of all other axes are zero."""
        action = {**STAND, **{f"base.{axis}": value for axis, value in wished.items()}}
        self.assertTrue(self.body.perform(RobotCommand(action, Permit(1, 1.0))))

    def test_robot_is_asked_for_nothing_that_it_has_not(self) -> None:
        """A robot without a sideways gait receives no sideways velocity, which its driver would refuse."""
        self.do(vx=0.1)
        self.assertEqual(self.robot.asked, [{"base.vx": 0.1, "base.wz": 0.0}])

    def test_what_it_really_does_is_learned(self) -> None:
        """If a robot turns faster than requested, all its behaviours aim more coarsely."""
        self.assertFalse(self.body.motion.is_coarse)
        self.do(wz=0.15)
        self.assertTrue(self.body.motion.is_coarse)
