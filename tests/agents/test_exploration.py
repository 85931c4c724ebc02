"""Tests of ``agents.exploration``: looking around and walking on."""

from __future__ import annotations

import copy
import math
import random

from twisted.trial.unittest import SynchronousTestCase

from agents.exploration import (
    AWAY,
    BACK,
    CLEARANCE,
    DETOUR_LEG,
    DETOUR_PATIENCE_S,
    LEG,
    OPEN,
    Detour,
    Exploration,
    Pose,
)
from agents.means import TURN_SPEED, Means

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
            self.assertGreater(abs(math.remainder(exploration._choose_heading((0.0, 0.0, 0.0)) - 2.0, math.tau)), 1.0)
        far = {round(exploration._choose_heading((3.0, 0.0, 0.0))) for _ in range(200)}
        self.assertIn(2, far)

    def walks_at(self, exploration: Exploration, yaw: float) -> bool:
        """Whether the robot would walk on when it looks this way."""
        return copy.deepcopy(exploration).step((0.0, 0.0, yaw), math.nan)["base.vx"] > 0.0


class DetourTests(SynchronousTestCase):
    def gone(self, detour: Detour, ahead: float = math.nan, moves: bool = True) -> tuple[list[Pose], float]:
        """Where a body that does what it is told (or does not move) comes by, and after how long it is round."""
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
        """First straight back, then round to the side, then a leg in the new direction."""
        for side in (1.0, -1.0):
            detour = Detour(Means())
            detour.begin((0.0, 0.0, 0.0), side, 0.0, has_touched=True)
            poses, _ = self.gone(detour)
            self.assertLess(abs(min(x for x, _, _ in poses) + BACK), 0.01)
            x, y, yaw = poses[-1]
            self.assertLess(abs(yaw - side * AWAY), 0.15)
            self.assertLess(abs(math.dist((x, y), (-BACK, 0.0)) - DETOUR_LEG), 0.02)
            self.assertGreater(side * y, 0.2)

    def test_leg_ends_before_the_next_thing(self) -> None:
        """With something close ahead the leg is not walked."""
        detour = Detour(Means())
        detour.begin((0.0, 0.0, 0.0), 1.0, 0.0, has_touched=False)
        poses, _ = self.gone(detour, ahead=0.2)
        self.assertEqual(poses[-1][:2], (0.0, 0.0))

    def test_who_is_stuck_gives_up(self) -> None:
        """A body that does not move is through after its patience for each of the three, and looks at things again."""
        detour = Detour(Means())
        detour.begin((0.0, 0.0, 0.0), 1.0, 0.0, has_touched=True)
        _, took = self.gone(detour, moves=False)
        self.assertLess(took, 3 * DETOUR_PATIENCE_S + 0.5)
        self.assertFalse(detour.is_on(took))

    def test_detour_that_nobody_walks_is_none(self) -> None:
        """Whoever is not asked for so long looks where it is now; and it can be ended at any time."""
        detour = Detour(Means())
        detour.begin((0.0, 0.0, 0.0), 1.0, 0.0, has_touched=True)
        self.assertTrue(detour.is_on(1.0))
        self.assertFalse(detour.is_on(DETOUR_PATIENCE_S + 1.0))
        detour.end()
        self.assertFalse(detour.is_on(1.0))
        self.assertIsNone(detour.step((0.0, 0.0, 0.0), math.nan, 1.0))
