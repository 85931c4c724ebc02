"""Tests of ``agents.detour``."""

from __future__ import annotations

import math

from twisted.trial.unittest import SynchronousTestCase

from agents.detour import AWAY, BACK, LEG, PATIENCE, Detour
from agents.exploration import Pose
from agents.means import Means

TICK = 0.05


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
            self.assertLess(abs(math.dist((x, y), (-BACK, 0.0)) - LEG), 0.02)
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
        self.assertLess(took, 3 * PATIENCE + 0.5)
        self.assertFalse(detour.is_on(took))

    def test_detour_that_nobody_walks_is_none(self) -> None:
        """Whoever is not asked for so long looks where it is now; and it can be ended at any time."""
        detour = Detour(Means())
        detour.begin((0.0, 0.0, 0.0), 1.0, 0.0, has_touched=True)
        self.assertTrue(detour.is_on(1.0))
        self.assertFalse(detour.is_on(PATIENCE + 1.0))
        detour.end()
        self.assertFalse(detour.is_on(1.0))
        self.assertIsNone(detour.step((0.0, 0.0, 0.0), math.nan, 1.0))
