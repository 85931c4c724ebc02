"""Tests of ``agents.motion``: the motion capabilities of a robot, from its description and its executed actions."""

from __future__ import annotations

import math
from dataclasses import replace

from twisted.trial.unittest import SynchronousTestCase

from agents.motion import FACING_TOLERANCE_RAD, MAX_FACING_TOLERANCE_RAD, STAND, STOP_DISTANCE_M, MotionCapabilities
from drivers.reading import Description
from tests.agents.roamer import described

WHEELS = Description("w", "", {"camera": {}}, {"base.vx": (-0.2, 0.2), "base.wz": (-2.0, 2.0)}, 0.1)


def with_camera(**properties: float) -> MotionCapabilities:
    """Return the motion capabilities of a wheeled robot with this camera."""
    return MotionCapabilities(replace(WHEELS, capabilities={"camera": properties}))


class DescriptionTests(SynchronousTestCase):
    def test_unknown_body_is_an_ers7(self) -> None:
        """A robot without a description has exactly the motion capabilities of the simulated dog."""
        for name in (
            "walk",
            "turn",
            "look_turn",
            "strafes",
            "ranges",
            "lens",
            "ahead",
            "stop_distance",
            "fresh",
            "facing_tolerance",
        ):
            self.assertEqual(
                getattr(MotionCapabilities(), name), getattr(MotionCapabilities(described("sim")), name), name
            )
        self.assertEqual(
            (
                MotionCapabilities().walk,
                MotionCapabilities().look_turn,
                MotionCapabilities().stop_distance,
                MotionCapabilities().facing_tolerance,
            ),
            (0.16, 1.6, STOP_DISTANCE_M, FACING_TOLERANCE_RAD),
        )

    def test_lens_is_as_described(self) -> None:
        """The lens is converted from degrees to radians; without a vertical angle the pixels are square."""
        self.assertEqual(with_camera(fov_h_deg=90.0).lens, (math.pi / 2, None))
        self.assertEqual(with_camera(fov_h_deg=90.0, fov_v_deg=60.0).lens, (math.pi / 2, math.radians(60.0)))
        self.assertEqual(with_camera().lens, MotionCapabilities().lens)

    def test_slow_camera_slows_the_turn(self) -> None:
        """At 2 frames per second the robot turns at most half its field of view per frame, and accepts older frames."""
        slow = MotionCapabilities(replace(WHEELS, rates={"camera": 2.0}))
        self.assertLess(slow.look_turn / 2.0, 0.51 * slow.lens[0])
        self.assertGreater(slow.fresh, 2 / 2.0)

    def test_broad_body_stops_earlier(self) -> None:
        """A wide robot stops when its camera is farther from the target than the camera of a narrow robot."""
        self.assertAlmostEqual(MotionCapabilities(described("create2")).stop_distance, 0.174 - 0.10 + 0.08)
        middle = MotionCapabilities(replace(WHEELS, capabilities={"camera": {"ahead": 0.01}}, radius=0.3))
        self.assertAlmostEqual(middle.stop_distance, 0.3 - 0.01 + 0.08)


class MissingAxesTests(SynchronousTestCase):
    def test_rest_on_an_axis_that_is_not_there_is_left_out(self) -> None:
        """A zero velocity on an axis that the robot lacks is removed.

        A nonzero velocity on such an axis is kept, so the driver refuses the action.
        """
        self.assertEqual(MotionCapabilities(WHEELS).remove_missing_axes(STAND), {"base.vx": 0.0, "base.wz": 0.0})
        self.assertEqual(MotionCapabilities().remove_missing_axes(STAND), STAND)
        aside = {"base.vy": 0.1}
        self.assertEqual(MotionCapabilities(WHEELS).remove_missing_axes(aside), aside)


class LearningTests(SynchronousTestCase):
    def turned(self, motion: MotionCapabilities, wished: float, done: float) -> None:
        """Let the robot learn that it executed a turn on the spot with the velocity ``done`` instead of ``wished``."""
        motion.learn({"base.vx": 0.0, "base.wz": wished}, {"base.vx": 0.0, "base.wz": done})

    def test_who_does_what_it_is_told_learns_nothing(self) -> None:
        """A robot that executes actions exactly, or clipped to its limits, keeps its fine aim."""
        motion = MotionCapabilities(WHEELS)
        for wished, done in ((0.5, 0.5), (5.0, 2.0), (0.01, 0.0100001)):
            self.turned(motion, wished, done)
        self.assertEqual(
            (motion.facing_tolerance, motion.is_coarse, motion.circle, motion.spin(0.01)),
            (FACING_TOLERANCE_RAD, False, 0.0, {**STAND, "base.wz": 0.01}),
        )

    def test_faster_turn_than_asked_for_is_a_coarse_aim(self) -> None:
        """A robot aims more coarsely the faster its slowest possible turn is, up to a limit."""
        motion = MotionCapabilities(replace(WHEELS, rates={"camera": 5.0}))
        self.turned(motion, 0.1, 1.0)
        large = motion.facing_tolerance
        self.turned(motion, 0.1, 0.5)
        self.assertTrue(FACING_TOLERANCE_RAD < motion.facing_tolerance < large <= MAX_FACING_TOLERANCE_RAD)
        self.assertTrue(motion.is_coarse)

    def test_turn_that_was_too_slow_is_tried_faster(self) -> None:
        """If a turn was too slow to move the robot, the next one is faster, in both directions."""
        motion = MotionCapabilities(WHEELS)
        self.turned(motion, 0.1, 0.0)
        self.assertAlmostEqual(motion.spin(-0.05)["base.wz"], -0.15)
        self.assertEqual(motion.spin(0.0), STAND)

    def test_who_cannot_turn_on_the_spot_walks_on_arcs(self) -> None:
        """A robot that does not turn on the spot at full speed walks while it turns, and learns its turning circle."""
        motion = MotionCapabilities(WHEELS)
        self.turned(motion, motion.look_turn, 0.0)
        action = motion.spin(1.0)
        self.assertGreater(action["base.vx"], 0.0)
        motion.learn(action, {"base.vx": 0.06, "base.wz": 0.4})
        self.assertAlmostEqual(motion.circle, 0.15)
        self.assertEqual(motion.spin(0.0), STAND)

    def test_creep_that_was_too_slow_is_tried_faster(self) -> None:
        """If a walk was too slow to move the robot, the next walk is faster.

        After a long step the robot stops earlier.
        """
        motion = MotionCapabilities(WHEELS)
        before = motion.stop_distance
        motion.learn({"base.vx": 0.04, "base.wz": 0.0}, {"base.vx": 0.0, "base.wz": 0.0})
        self.assertAlmostEqual(motion.go(0.04)["base.vx"], 0.06)
        self.assertAlmostEqual(motion.go(-0.04)["base.vx"], -0.06)
        motion.learn({"base.vx": 0.06, "base.wz": 0.0}, {"base.vx": 0.15, "base.wz": 0.0})
        self.assertTrue(before < motion.stop_distance < before + 0.05)
