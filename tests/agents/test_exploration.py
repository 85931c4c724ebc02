"""Tests of ``agents.exploration``: looking around, walking on, and detours around obstacles."""

from __future__ import annotations

import copy
import math
import random

from twisted.trial.unittest import SynchronousTestCase

from agents.exploration import (
    BACK_OFF_M,
    CLEARANCE_M,
    DETOUR_LEG_M,
    DETOUR_LEG_TIMEOUT_S,
    DETOUR_TURN_RAD,
    LEG_M,
    OPEN_RANGE_M,
    Detour,
    Exploration,
    Pose,
)
from agents.motion import MAX_SEARCH_TURN_RADPS, MotionCapabilities

TICK = 0.05


class Walker:
    """A point in a square room that executes each action of the exploration immediately."""

    def __init__(self, seed: int, side: float = 3.0) -> None:
        self.exploration = Exploration(random.Random(seed))
        self.side = side
        self.pose: Pose = (side / 2, side / 2, 0.3)
        self.turned = 0.0

    @property
    def ahead(self) -> float:
        """Return the range ahead in metres; NaN beyond 1.5 m."""
        x, y, yaw = self.pose
        cos, sin = math.cos(yaw), math.sin(yaw)
        walls = [(self.side - x) / cos if cos > 0 else -x / cos if cos < 0 else math.inf]
        walls.append((self.side - y) / sin if sin > 0 else -y / sin if sin < 0 else math.inf)
        return min(walls) if min(walls) < OPEN_RANGE_M else math.nan

    def live(self) -> float:
        """Run one tick and return the forward speed."""
        self.exploration.update(self.pose, self.turned, self.ahead)
        action = self.exploration.step(self.pose, self.ahead)
        x, y, yaw = self.pose
        v, w = action["base.vx"], action["base.wz"]
        self.turned = w * TICK
        self.pose = (
            x + v * math.cos(yaw) * TICK,
            y + v * math.sin(yaw) * TICK,
            math.remainder(yaw + self.turned, math.tau),
        )
        return v


class ExplorationTests(SynchronousTestCase):
    def test_look_all_around_before_walking(self) -> None:
        """The robot turns a full circle within eight seconds before it takes its first step."""
        for seed in range(5):
            walker = Walker(seed)
            ticks, turned = 0, 0.0
            while walker.live() == 0.0 and ticks < 400:
                ticks += 1
                turned += abs(walker.turned)
            self.assertGreaterEqual(turned, math.tau, seed)
            self.assertLess(ticks * TICK, 8.0, seed)

    def test_walk_stays_off_the_walls(self) -> None:
        """In two minutes in a closed room the robot keeps its clearance to every wall ahead."""
        for seed in range(5):
            walker = Walker(seed)
            for _ in range(2400):
                if walker.live() > 0.0:
                    self.assertFalse(walker.ahead < CLEARANCE_M - 0.02, (seed, walker.pose))
                x, y, _yaw = walker.pose
                self.assertTrue(0.0 < x < 3.0 and 0.0 < y < 3.0, (seed, walker.pose))

    def test_leg_ends_and_the_robot_looks_around_again(self) -> None:
        """After a straight walk (a leg) of at most ``LEG_M`` metres the robot stops and turns."""
        walker = Walker(1, side=50.0)
        while walker.live() == 0.0:
            pass
        start = walker.pose[:2]
        while walker.live() > 0.0:
            self.assertLess(math.dist(start, walker.pose[:2]), LEG_M + 0.05)
        walker.live()
        self.assertAlmostEqual(abs(walker.turned), MAX_SEARCH_TURN_RADPS * TICK)

    def test_most_open_way_is_taken(self) -> None:
        """The robot walks in the direction of the longest range."""
        exploration = Exploration(random.Random(1))
        pose: Pose = (0.0, 0.0, 0.0)
        turned = 0.0
        for n in range(70):
            yaw = math.remainder(n * 0.1, math.tau)
            pose = (0.0, 0.0, yaw)
            exploration.update(pose, turned, math.nan if abs(yaw - 2.0) < 0.15 else 0.5)
            turned = 0.1
        exploration.step(pose, 0.5)
        walks = [yaw for yaw in (n * 0.1 - 3.1 for n in range(63)) if self.walks_at(exploration, yaw)]
        self.assertTrue(walks)
        self.assertTrue(all(abs(yaw - 2.0) < 0.35 for yaw in walks), walks)

    def test_way_that_ended_in_a_bump_is_not_tried_again_at_once(self) -> None:
        """A robot without a ranger does not choose the heading of a recent bump when it is near that location."""
        for seed in range(20):
            exploration = Exploration(random.Random(seed))
            exploration.on_bump((0.1, 0.0, 2.0))
            for n in range(70):
                exploration.update((0.0, 0.0, math.remainder(n * 0.1, math.tau)), 0.1 if n else 0.0, math.nan)
            self.assertGreater(abs(math.remainder(exploration._choose_heading((0.0, 0.0, 0.0)) - 2.0, math.tau)), 1.0)
        far = {round(exploration._choose_heading((3.0, 0.0, 0.0))) for _ in range(200)}
        self.assertIn(2, far)

    def walks_at(self, exploration: Exploration, yaw: float) -> bool:
        """Return whether the robot would walk forward at this heading."""
        return copy.deepcopy(exploration).step((0.0, 0.0, yaw), math.nan)["base.vx"] > 0.0


class DetourTests(SynchronousTestCase):
    def gone(self, detour: Detour, ahead: float = math.nan, moves: bool = True) -> tuple[list[Pose], float]:
        """Follow this detour; return the robot's poses and the duration. With ``moves`` false the robot is stuck."""
        pose: Pose = (0.0, 0.0, 0.0)
        poses, now = [pose], 0.0
        while (action := detour.step(pose, ahead, now)) is not None:
            now += TICK
            if moves:
                x, y, yaw = pose
                way = action["base.vx"] * TICK
                pose = (x + way * math.cos(yaw), y + way * math.sin(yaw), yaw + action["base.wz"] * TICK)
            poses.append(pose)
        return poses, now

    def test_who_touched_backs_off_turns_away_and_walks(self) -> None:
        """After a contact the robot backs off, turns away from the contact, and walks a leg in the new direction."""
        for side in (1.0, -1.0):
            detour = Detour(MotionCapabilities())
            detour.start((0.0, 0.0, 0.0), side, 0.0, has_touched=True)
            poses, _ = self.gone(detour)
            self.assertLess(abs(min(x for x, _, _ in poses) + BACK_OFF_M), 0.01)
            x, y, yaw = poses[-1]
            self.assertLess(abs(yaw - side * DETOUR_TURN_RAD), 0.15)
            self.assertLess(abs(math.dist((x, y), (-BACK_OFF_M, 0.0)) - DETOUR_LEG_M), 0.02)
            self.assertGreater(side * y, 0.2)

    def test_leg_ends_before_the_next_thing(self) -> None:
        """If an obstacle is close ahead, the robot omits the walk (leg) at the end of the detour."""
        detour = Detour(MotionCapabilities())
        detour.start((0.0, 0.0, 0.0), 1.0, 0.0, has_touched=False)
        poses, _ = self.gone(detour, ahead=0.2)
        self.assertEqual(poses[-1][:2], (0.0, 0.0))

    def test_who_is_stuck_gives_up(self) -> None:
        """If a robot cannot move, each of the three phases of its detour ends by timeout."""
        detour = Detour(MotionCapabilities())
        detour.start((0.0, 0.0, 0.0), 1.0, 0.0, has_touched=True)
        _, took = self.gone(detour, moves=False)
        self.assertLess(took, 3 * DETOUR_LEG_TIMEOUT_S + 0.5)
        self.assertFalse(detour.is_active(took))

    def test_detour_that_nobody_walks_is_none(self) -> None:
        """A detour with steps that are not requested expires after a timeout; ``cancel`` ends a detour at any time."""
        detour = Detour(MotionCapabilities())
        detour.start((0.0, 0.0, 0.0), 1.0, 0.0, has_touched=True)
        self.assertTrue(detour.is_active(1.0))
        self.assertFalse(detour.is_active(DETOUR_LEG_TIMEOUT_S + 1.0))
        detour.cancel()
        self.assertFalse(detour.is_active(1.0))
        self.assertIsNone(detour.step((0.0, 0.0, 0.0), math.nan, 1.0))
