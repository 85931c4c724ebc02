"""Tests of ``agents.exploration``: looking around and walking on."""

from __future__ import annotations

import copy
import math
import random

from twisted.trial.unittest import SynchronousTestCase

from agents.exploration import CLEARANCE, LEG, OPEN, Exploration, Pose
from agents.means import TURN_SPEED

TICK = 0.05


class Walker:
    """A point in a square room that does at once what the exploration says."""

    def __init__(self, seed: int, side: float = 3.0) -> None:
        self.exploration = Exploration(random.Random(seed))
        self.side = side
        self.pose: Pose = (side / 2, side / 2, 0.3)
        self.turned = 0.0

    @property
    def ahead(self) -> float:
        """The range ahead; NaN beyond 1.5 m."""
        x, y, yaw = self.pose
        cos, sin = math.cos(yaw), math.sin(yaw)
        walls = [(self.side - x) / cos if cos > 0 else -x / cos if cos < 0 else math.inf]
        walls.append((self.side - y) / sin if sin > 0 else -y / sin if sin < 0 else math.inf)
        return min(walls) if min(walls) < OPEN else math.nan

    def live(self) -> float:
        """One tick; the speed ahead."""
        self.exploration.saw(self.pose, self.turned, self.ahead)
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
        """No step is made before the whole circle was looked at, which takes no more than five seconds."""
        for seed in range(5):
            walker = Walker(seed)
            ticks, turned = 0, 0.0
            while walker.live() == 0.0 and ticks < 400:
                ticks += 1
                turned += abs(walker.turned)
            self.assertGreaterEqual(turned, math.tau, seed)
            self.assertLess(ticks * TICK, 8.0, seed)

    def test_walk_stays_off_the_walls(self) -> None:
        """In two minutes in a closed room the robot never comes nearer to a wall ahead than the clearance allows."""
        for seed in range(5):
            walker = Walker(seed)
            for _ in range(2400):
                if walker.live() > 0.0:
                    self.assertFalse(walker.ahead < CLEARANCE - 0.02, (seed, walker.pose))
                x, y, _yaw = walker.pose
                self.assertTrue(0.0 < x < 3.0 and 0.0 < y < 3.0, (seed, walker.pose))

    def test_leg_ends_and_the_robot_looks_around_again(self) -> None:
        """After a leg of its length the robot stands and turns."""
        walker = Walker(1, side=50.0)
        while walker.live() == 0.0:
            pass
        start = walker.pose[:2]
        while walker.live() > 0.0:
            self.assertLess(math.dist(start, walker.pose[:2]), LEG + 0.05)
        walker.live()
        self.assertAlmostEqual(abs(walker.turned), TURN_SPEED * TICK)

    def test_most_open_way_is_taken(self) -> None:
        """Of all headings looked at, one with the most room is walked."""
        exploration = Exploration(random.Random(1))
        pose: Pose = (0.0, 0.0, 0.0)
        turned = 0.0
        for n in range(70):
            yaw = math.remainder(n * 0.1, math.tau)
            pose = (0.0, 0.0, yaw)
            exploration.saw(pose, turned, math.nan if abs(yaw - 2.0) < 0.15 else 0.5)
            turned = 0.1
        exploration.step(pose, 0.5)
        walks = [yaw for yaw in (n * 0.1 - 3.1 for n in range(63)) if self.walks_at(exploration, yaw)]
        self.assertTrue(walks)
        self.assertTrue(all(abs(yaw - 2.0) < 0.35 for yaw in walks), walks)

    def test_way_that_ended_in_a_bump_is_not_tried_again_at_once(self) -> None:
        """Where nothing is ranged, the heading of a bump is shut for as long as the robot is near that place."""
        for seed in range(20):
            exploration = Exploration(random.Random(seed))
            exploration.bumped((0.1, 0.0, 2.0))
            for n in range(70):
                exploration.saw((0.0, 0.0, math.remainder(n * 0.1, math.tau)), 0.1 if n else 0.0, math.nan)
            self.assertGreater(abs(math.remainder(exploration._most_open((0.0, 0.0, 0.0)) - 2.0, math.tau)), 1.0)
        far = {round(exploration._most_open((3.0, 0.0, 0.0))) for _ in range(200)}
        self.assertIn(2, far)

    def walks_at(self, exploration: Exploration, yaw: float) -> bool:
        """Whether the robot would walk on when it looks this way."""
        return copy.deepcopy(exploration).step((0.0, 0.0, yaw), math.nan)["base.vx"] > 0.0
