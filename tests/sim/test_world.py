"""Tests of ``sim.robots.world`` and ``sim.robots.dog``."""

from __future__ import annotations

import math
from random import Random

from twisted.trial.unittest import SynchronousTestCase

from sim.robots.scene import FOOTPRINT_RADIUS_M, load_scene
from sim.robots.world import SUBSTEP_S, NotPossible, World


def make_world(seed: int = 1) -> World:
    """Return a world in which the three dogs are far apart."""
    return World(Random(seed), load_scene("three-dogs"))


def run(world: World, seconds: float) -> None:
    """Run the physics for some seconds."""
    for _ in range(round(seconds / SUBSTEP_S)):
        world.step()


class WorldTests(SynchronousTestCase):
    """The physics of the robot simulator."""

    def setUp(self) -> None:
        """Create a world with dog1 in the middle, facing right."""
        self.world = make_world()
        self.dog = self.world.dogs["dog1"]
        self.world.move_dog("dog1", 1.4, 1.0, 0.0)

    def test_walks_as_far_as_an_aibo(self) -> None:
        """The speed is limited to 0.16 m/s: in two seconds a dog walks 0.29 to 0.32 m, because it has to accelerate."""
        self.world.drive("dog1", 5.0, 0.0, 0.0)
        run(self.world, 2.0)
        self.assertAlmostEqual(self.dog.motion.vx, 0.160, 6)
        self.assertTrue(1.4 + 0.29 < self.dog.x < 1.4 + 0.32, self.dog.x)
        self.assertAlmostEqual(self.dog.y, 1.0, 6)

    def test_moves_in_its_own_frame(self) -> None:
        """Velocities are relative to the dog: if it faces up, a step to the left decreases x.

        Turns are counter-clockwise.
        """
        self.world.move_dog("dog1", 1.4, 1.0, math.pi / 2)
        self.world.drive("dog1", 0.0, 0.1, 0.0)
        run(self.world, 1.0)
        self.assertLess(self.dog.x, 1.4 - 0.07)
        self.world.drive("dog1", 0.0, 0.0, 1.0)
        run(self.world, 0.5)
        self.assertGreater(self.dog.heading, math.pi / 2 + 0.4)

    def test_needs_time_to_start_and_to_stop(self) -> None:
        """The speed changes gradually; a dog at full speed stops within a tenth of a second."""
        self.world.drive("dog1", 0.16, 0.0, 0.0)
        run(self.world, 0.05)
        self.assertTrue(0.01 < self.dog.motion.vx < 0.08)
        run(self.world, 1.0)
        self.world.halt("dog1")
        self.world.step()
        self.assertGreater(self.dog.motion.vx, 0.1)
        run(self.world, 0.1)
        self.assertFalse(self.dog.is_moving)

    def test_stays_between_the_walls(self) -> None:
        """A minute of walking against walls and into corners never moves a dog more than 3 mm into them."""
        for name, turn in (("dog1", 0.0), ("dog2", 0.3), ("dog3", -0.2)):
            self.world.drive(name, 0.16, 0.05, turn)
        for _ in range(round(60 / SUBSTEP_S)):
            self.world.step()
            for dog in self.world.dogs.values():
                self.assertTrue(FOOTPRINT_RADIUS_M - 0.003 < dog.x < 3.0 - FOOTPRINT_RADIUS_M + 0.003, dog.x)
                self.assertTrue(FOOTPRINT_RADIUS_M - 0.003 < dog.y < 2.4 - FOOTPRINT_RADIUS_M + 0.003, dog.y)
        self.assertGreater(self.world.collisions, 0)

    def test_pushes_another_dog_but_not_the_target(self) -> None:
        """A dog pushes another dog without overlap, but cannot push the target."""
        self.world.move_dog("dog2", 1.8, 1.0, 0.0)
        self.world.drive("dog1", 0.16, 0.0, 0.0)
        run(self.world, 4.0)
        other = self.world.dogs["dog2"]
        self.assertGreater(math.hypot(other.x - self.dog.x, other.y - self.dog.y), 2 * FOOTPRINT_RADIUS_M - 0.005)
        self.assertGreaterEqual(self.world.collisions, 1)
        self.world.move_dog("dog2", 2.7, 0.3, 0.0)
        self.world.move_dog("dog1", 1.4, 1.0, 0.0)
        self.world.place_target(1.8, 1.0)
        run(self.world, 4.0)
        self.assertLess(self.dog.x, 1.8 - 0.08 - FOOTPRINT_RADIUS_M + 0.005)
        assert self.world.target is not None
        self.assertEqual((self.world.target.x, self.world.target.y), (1.8, 1.0))

    def test_measures_ahead(self) -> None:
        """The measured distance ends at a wall, another dog or the target; out of range it is None."""
        self.assertIsNone(self.world.distance_ahead(self.dog, 0.1, 1.0))
        self.assertAlmostEqual(self.world.distance_ahead(self.dog, 0.1, 3.0) or 0.0, 1.5, 6)
        self.world.place_target(2.0, 1.0)
        self.assertAlmostEqual(self.world.distance_ahead(self.dog, 0.1, 1.0) or 0.0, 0.42, 6)
        self.world.move_dog("dog2", 1.75, 1.0, 0.0)
        self.assertAlmostEqual(self.world.distance_ahead(self.dog, 0.1, 1.0) or 0.0, 0.13, 6)
        self.world.clear_target()
        self.world.move_dog("dog2", 2.4, 0.5, 0.0)
        self.assertIsNone(self.world.distance_ahead(self.dog, 0.1, 1.0))

    def test_places_the_target_later(self) -> None:
        """A target with a delay appears after the delay, unless a target was placed or removed during the delay."""
        self.world.place_target_later(1.0)
        run(self.world, 0.9)
        self.assertIsNone(self.world.target)
        run(self.world, 0.2)
        self.assertIsNotNone(self.world.target)
        for change in (self.world.clear_target, lambda: self.world.place_target(2.0, 2.0)):
            self.world.place_target_later(1.0)
            change()
            before = self.world.target
            run(self.world, 1.2)
            self.assertEqual(self.world.target, before)
        for seconds in (-1.0, 1e9, math.nan):
            self.assertRaises(NotPossible, self.world.place_target_later, seconds)

    def test_places_the_target_clear_of_everything(self) -> None:
        """For each seed the distances of the dogs to the random target differ, so one dog is clearly the nearest."""
        for seed in range(60):
            world, same = make_world(seed), make_world()
            for each in (world, same):
                each.scatter(seed)
            self.assertEqual(world.snapshot(), same.snapshot())
            world.place_target_at_random()
            target = world.target
            assert target is not None
            self.assertTrue(0.25 <= target.x <= 2.75 and 0.25 <= target.y <= 2.15)
            far = sorted(math.hypot(dog.x - target.x, dog.y - target.y) for dog in world.dogs.values())
            self.assertGreaterEqual(far[0], 0.45)
            self.assertGreaterEqual(min(far[1] - far[0], far[2] - far[1]), 0.25 - 1e-9, seed)

    def test_refuses_impossible_orders(self) -> None:
        """Positions in walls, dogs or the target, and unknown dogs, are rejected; nothing moves."""
        self.world.place_target(2.0, 2.0)
        before = self.world.snapshot()
        for order in (
            lambda: self.world.place_target(1.4, 1.1),
            lambda: self.world.place_target(math.nan, 1.0),
            lambda: self.world.place_target(3.0, 1.0),
            lambda: self.world.move_dog("dog2", 1.5, 1.0, 0.0),
            lambda: self.world.move_dog("dog2", 2.0, 1.9, 0.0),
            lambda: self.world.move_dog("dog2", 0.0, 1.0, 0.0),
            lambda: self.world.move_dog("dog2", 2.0, 1.0, math.inf),
            lambda: self.world.move_dog("cat", 1.0, 1.0, 0.0),
        ):
            self.assertRaises(NotPossible, order)
        self.assertEqual(self.world.snapshot(), before)
