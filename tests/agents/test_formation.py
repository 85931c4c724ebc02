"""Tests of ``agents.formation``: robots that do not act move to evenly spaced waiting positions, their posts."""

from __future__ import annotations

import math
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from agents.formation import MIN_CIRCLING_RADIUS_M, Formation, Post, PostPath, assign_posts, assign_sector
from middleware.tasks.task import Member

ANGLES = st.lists(st.floats(-math.pi, math.pi), min_size=1, max_size=6, unique=True)


def apart(one: float, other: float) -> float:
    """Return the angle between two directions in radians."""
    return abs(math.remainder(one - other, math.tau))


class PostTests(SynchronousTestCase):
    @settings(max_examples=80)
    @given(ANGLES, st.randoms(use_true_random=False))
    def test_even_and_the_same_for_all(self, angles: list[float], rng: Any) -> None:
        """The posts are evenly spaced around the target, and do not depend on the order of the reports."""
        named = [(f"{number}", angle) for number, angle in enumerate(angles)]
        placed = assign_posts(named, None)
        rng.shuffle(named)
        self.assertEqual(assign_posts(named, None), placed)
        around = sorted(angle % math.tau for angle in placed.values())
        for one, other in zip(around, around[1:], strict=False):
            self.assertAlmostEqual(other - one, math.tau / len(angles), 6)

    @settings(max_examples=80)
    @given(ANGLES)
    def test_no_way_crosses_another(self, angles: list[float]) -> None:
        """The robots keep their angular order around the target, and the assigned robot does not move."""
        named = sorted(((f"{number}", angle) for number, angle in enumerate(angles)), key=lambda one: one[1] % math.tau)
        placed = assign_posts(named, named[0][0])
        self.assertAlmostEqual(apart(placed[named[0][0]], named[0][1]), 0.0, 6)
        turns = [(placed[uuid] - placed[named[0][0]]) % math.tau for uuid, _ in named[1:]]
        self.assertEqual(turns, sorted(turns))

    def test_at_their_posts_nobody_moves(self) -> None:
        """Robots that are already evenly spaced keep their positions."""
        named = [(name, math.remainder(0.7 + n * math.tau / 3, math.tau)) for n, name in enumerate("abc")]
        for assigned in (None, "b"):
            placed = assign_posts(named, assigned)
            for name, angle in named:
                self.assertAlmostEqual(apart(placed[name], angle), 0.0, 6)

    def test_sectors_share_the_circle(self) -> None:
        """Each of three robots searches a third of the circle.

        When one robot leaves, each of the two remaining robots searches half of the circle.
        """
        self.assertEqual(assign_sector("b", {"a", "b", "c"}), (math.pi, math.tau / 3))
        self.assertEqual(assign_sector("b", {"a", "b"}), (math.remainder(1.5 * math.pi, math.tau), math.pi))


class Robot:
    """A behaviour that records its posts."""

    def __init__(self) -> None:
        self.sent: list[Post] = []

    def take_post(self, post: Post) -> None:
        """Record the post."""
        self.sent.append(post)


class FormationTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.robot = Robot()
        self.formation = Formation("a", self.robot)  # type: ignore[arg-type]
        self.me = Member("a", "dog1", "WAITING", 1.0, angle=0.0)
        self.others = [Member("b", "dog2", "WAITING", 1.0, angle=0.2), Member("c", "dog3", "WAITING", 1.0, angle=2.0)]

    def test_rests_until_somebody_leaves(self) -> None:
        """The robots get no posts until a robot leaves.

        Then the remaining robots, and robots that join later, get evenly spaced posts.
        """
        self.assertEqual(self.formation.update_members(self.others), [])
        self.assertIsNone(self.formation.assign_post(self.me, self.others, None))
        self.assertEqual(self.robot.sent, [])
        self.assertEqual(self.formation.update_members(self.others[:1]), ["c"])
        self.assertAlmostEqual(self.formation.assign_post(self.me, self.others[:1], "b") or 0.0, 0.2 - math.pi, 1)
        self.assertEqual(self.robot.sent[-1].sector[1], math.pi)
        self.formation.update_members(self.others)
        self.formation.assign_post(self.me, self.others, "b")
        self.assertEqual(self.robot.sent[-1].sector[1], math.tau / 3)

    def test_who_is_to_act_has_no_post(self) -> None:
        """The assigned robot gets no post."""
        self.formation.update_members(self.others)
        self.formation.update_members([])
        self.assertIsNone(self.formation.assign_post(self.me, self.others, "a"))
        self.assertIsNone(self.robot.sent[-1].angle)

    def test_post_does_not_follow_every_word(self) -> None:
        """A post changes only by more than a minimum distance."""
        self.formation.update_members(self.others)
        self.formation.update_members([])
        first = self.formation.assign_post(self.me, self.others[:1], "b")
        near = [Member("b", "dog2", "WAITING", 1.0, angle=0.3)]
        self.assertEqual(self.formation.assign_post(self.me, near, "b"), first)
        far = [Member("b", "dog2", "WAITING", 1.0, angle=1.3)]
        self.assertNotEqual(self.formation.assign_post(self.me, far, "b"), first)


class PostPathTests(SynchronousTestCase):
    def walk(self, radius: float, post: float, ahead: float = math.nan, seconds: float = 60.0) -> tuple[float, float]:
        """Move a robot to its post around a target at (0, 0).

        Return its final direction and distance from the target.
        """
        x, y, yaw = radius, 0.0, math.pi
        circling = PostPath()
        circling.set_post(post)
        for _ in range(int(seconds / 0.05)):
            facing = math.remainder(math.atan2(-y, -x) - yaw, math.tau)
            action = circling.step((x, y, yaw), (0.0, 0.0), math.atan2(y, x), ahead, abs(facing) < 0.05)
            if action is None:
                yaw += 0.05 * max(-1.6, min(1.6, 2.2 * facing))
                continue
            yaw += 0.05 * action["base.wz"]
            x += 0.05 * action["base.vx"] * math.cos(yaw)
            y += 0.05 * action["base.vx"] * math.sin(yaw)
        return math.atan2(y, x), math.hypot(x, y)

    def test_reaches_its_post_at_the_same_distance(self) -> None:
        """The robot ends near its post at its original distance from the target, on either side."""
        for post in (2.0, -1.0, 3.1):
            angle, distance = self.walk(1.2, post)
            self.assertLess(apart(angle, post), math.radians(21))
            self.assertLess(abs(distance - 1.2), 0.1)

    def test_stops_before_what_is_in_the_way(self) -> None:
        """The robot does not move towards its post if an obstacle is ahead or if the target is too close."""
        self.assertLess(apart(self.walk(1.2, 2.0, ahead=0.3)[0], 0.0), 0.05)
        self.assertLess(apart(self.walk(MIN_CIRCLING_RADIUS_M - 0.05, 2.0)[0], 0.0), 0.01)
