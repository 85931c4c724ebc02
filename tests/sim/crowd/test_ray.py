"""Tests of ``sim.robots.crowd.ray``: the vectorized rays measure the same distances as the rays of ``World``."""

from __future__ import annotations

import math
from random import Random

import numpy as np
from twisted.trial.unittest import SynchronousTestCase

from sim.robots.crowd.crowd import RAY_LENGTH_M, RAYS, Crowd
from sim.robots.crowd.ray import Rays
from sim.robots.crowd.scene import CrowdScene
from sim.robots.scene import FOOTPRINT_RADIUS_M, DogPlacement, Scene
from sim.robots.world import World


def twin(crowd: Crowd) -> World:
    """Build a ``World`` with the robots and the target at the same positions."""
    crowd_scene = crowd.scene
    placements = tuple(
        DogPlacement(f"dog{n}", float(crowd.x[n]), float(crowd.y[n]), float(crowd.heading[n]), 1)
        for n in range(len(crowd.x))
    )
    scene = Scene(
        "twin",
        crowd_scene.width,
        crowd_scene.height,
        0.4,
        crowd_scene.target_radius,
        crowd_scene.target_height,
        placements,
    )
    world = World(Random(1), scene)
    if crowd.target is not None:
        world.place_target(crowd.target.x, crowd.target.y)
    return world


def one_by_one(world: World, crowd: Crowd, body: int) -> list[float]:
    """Return the lengths of the rays from ``body`` that ``segment_query_first`` measures one by one."""
    x, y, heading = (float(row[body]) for row in (crowd.x, crowd.y, crowd.heading))
    dog, found = world.dogs[f"dog{body}"], []
    for ray in range(RAYS):
        dog.place(x, y, heading + ray * math.tau / RAYS)
        hit = world.distance_ahead(dog, 0.0, RAY_LENGTH_M)
        found.append(RAY_LENGTH_M if hit is None else hit)
    return found


class TwinTests(SynchronousTestCase):
    def check(self, crowd: Crowd) -> int:
        """Compare all rays and return the number of rays that hit something."""
        world = twin(crowd)
        rows = np.array([one_by_one(world, crowd, body) for body in range(len(crowd.x))])
        self.assertLess(float(np.abs(rows - crowd.ranges).max()), 0.001)
        return int((rows < RAY_LENGTH_M).sum())

    def test_random_scenes(self) -> None:
        """On sparse and dense maps, with and without a target, each ray matches ``World`` within a millimetre."""
        met = 0
        for seed, (bodies, side) in enumerate([(12, 3.0), (40, 4.0), (80, 4.0), (60, 9.0), (30, 12.0)] * 4):
            crowd = Crowd(seed, CrowdScene(bodies, side, side + 0.7))
            if seed % 2 and bodies < 80:
                crowd.place_target_at_random()
            met += self.check(crowd)
        self.assertGreater(met, 2000)

    def test_still_holds_after_they_have_moved(self) -> None:
        """Rays still match after 120 steps: no robot that has come close is missing from the cached neighbours."""
        crowd = Crowd(3, CrowdScene(40, 5.0, 5.0))
        for turn in range(120):
            crowd.commands[:] = (0.16, 0.0, 0.4 * math.sin(turn / 20))
            crowd.step()
            if turn % 40 == 39:
                self.check(crowd)


class RaysTests(SynchronousTestCase):
    def test_grazing_rays(self) -> None:
        """A ray that passes 0.1 mm outside a disc misses it; a ray 0.1 mm inside hits it."""
        rays = Rays(6.0, 4.0, RAYS, RAY_LENGTH_M)
        for side, is_met in ((FOOTPRINT_RADIUS_M + 1e-4, False), (FOOTPRINT_RADIUS_M - 1e-4, True)):
            row = rays.cast(np.array([2.0, 3.0]), np.array([2.0, 2.0 + side]), np.zeros(2))[0]
            self.assertEqual(row[0] < RAY_LENGTH_M, is_met)
            if is_met:
                self.assertAlmostEqual(row[0], 1.0 - math.sqrt(FOOTPRINT_RADIUS_M**2 - side**2), 6)
