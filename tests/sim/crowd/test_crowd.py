"""Tests of ``sim.robots.crowd.crowd`` and ``scene``: collisions, placement, controllers and reproducibility."""

from __future__ import annotations

import math
from random import Random

import numpy as np
from twisted.trial.unittest import SynchronousTestCase

from sim.robots.crowd.controller import CONTROLLERS, Readings
from sim.robots.crowd.crowd import Crowd
from sim.robots.crowd.scene import CELL_M, MAX_ROBOTS, CrowdScene, make_square_scene
from sim.robots.scene import FOOTPRINT_RADIUS_M, DogPlacement, Scene, SceneError
from sim.robots.world import SUBSTEP_S, TICK_S, NotPossible, World
from tests.replay import replayed

RUN = """
from sim.robots.crowd.controller import CONTROLLERS, Readings
from sim.robots.crowd.crowd import Crowd
from sim.robots.crowd.scene import make_square_scene
crowd = Crowd(7, make_square_scene(400, 0.2))
for turn in range(150):
    crowd.commands[:] = CONTROLLERS["wander"](Readings(crowd))
    crowd.step()
print(crowd.digest())
"""


def press(crowd: Crowd, seconds: float) -> float:
    """Drive all robots towards the middle of the map; return the largest overlap in metres."""
    worst = 0.0
    for _ in range(round(seconds / TICK_S)):
        towards = np.arctan2(crowd.scene.height / 2 - crowd.y, crowd.scene.width / 2 - crowd.x)
        off = np.remainder(towards - crowd.heading + math.pi, math.tau) - math.pi
        crowd.commands[:, 0] = np.where(np.abs(off) < 0.5, 0.16, 0.0)
        crowd.commands[:, 2] = 2.0 * off
        crowd.step()
        worst = max(worst, crowd.measure_overlap())
    return worst


class CrowdTests(SynchronousTestCase):
    def test_nobody_overlaps_or_leaves(self) -> None:
        """Three hundred robots that push towards the middle overlap by at most 6 mm and stay inside the walls."""
        crowd = Crowd(1, make_square_scene(300, 0.15))
        worst = press(crowd, 20.0)
        self.assertGreater(worst, 0.0)
        self.assertLess(worst, 0.006)
        for row, side in ((crowd.x, crowd.scene.width), (crowd.y, crowd.scene.height)):
            self.assertGreaterEqual(float(row.min()), FOOTPRINT_RADIUS_M)
            self.assertLessEqual(float(row.max()), side - FOOTPRINT_RADIUS_M)

    def test_nobody_enters_the_target(self) -> None:
        """A robot that drives at the target stops at its surface, and the target does not move."""
        crowd = Crowd(2, CrowdScene(1, 3.0, 3.0))
        crowd.move(0, 1.0, 1.5, 0.0)
        crowd.place_target(1.5, 1.5)
        crowd.commands[0] = (0.16, 0.0, 0.0)
        for _ in range(200):
            crowd.step()
        self.assertAlmostEqual(float(crowd.x[0]), 1.5 - 0.08 - FOOTPRINT_RADIUS_M, 3)
        self.assertAlmostEqual(float(crowd.ranges[0, 0]), FOOTPRINT_RADIUS_M, 3)

    def test_walks_as_a_dog_of_the_yard(self) -> None:
        """With the same commands, a crowd robot and a robot of ``World`` end within 2 cm of each other after 6 s."""
        scene = Scene("one", 6.0, 6.0, 0.4, 0.08, 0.22, (DogPlacement("dog", 3.0, 3.0, 0.3, 1),))
        world, crowd = World(Random(1), scene), Crowd(1, CrowdScene(1, 6.0, 6.0))
        crowd.move(0, 3.0, 3.0, 0.3)
        for order in ((0.16, 0.0, 0.0), (0.5, -0.1, 1.0), (0.0, 0.0, -3.0), (-0.1, 0.05, 0.2), (0.0, 0.0, 0.0)):
            world.drive("dog", *order)
            crowd.commands[0] = order
            for _ in range(round(1.2 / TICK_S)):
                crowd.step()
                for _ in range(round(TICK_S / SUBSTEP_S)):
                    world.step()
        dog = world.dogs["dog"]
        self.assertLess(math.dist((dog.x, dog.y), (crowd.x[0], crowd.y[0])), 0.02)
        self.assertLess(abs(math.remainder(dog.heading - float(crowd.heading[0]), math.tau)), 0.1)
        self.assertLess(float(np.hypot(crowd.vx, crowd.vy)[0]), 1e-9)

    def test_same_seed_gives_the_same_hash(self) -> None:
        """A run with collisions gives the same digest in two processes; a different seed gives a different digest."""
        replayed(self, RUN)
        self.assertNotEqual(Crowd(7, make_square_scene(50)).digest(), Crowd(8, make_square_scene(50)).digest())

    def test_things_are_placed_where_there_is_room(self) -> None:
        """Target and robots cannot be placed in walls or on each other.

        On a full map a target cannot be placed at all.
        """
        crowd = Crowd(1, CrowdScene(2, 3.0, 3.0))
        crowd.move(0, 1.0, 1.0, 0.0)
        for place in ((0.0, 1.0), (1.1, 1.0), (math.nan, 1.0)):
            self.assertRaises(NotPossible, crowd.place_target, *place)
            self.assertRaises(NotPossible, crowd.move, 1, *place, 0.0)
        crowd.place_target_at_random()
        full = Crowd(1, CrowdScene(121, 11 * CELL_M, 11 * CELL_M))
        self.assertRaises(NotPossible, full.place_target_at_random)


class CrowdSceneTests(SynchronousTestCase):
    def test_too_small_is_refused_with_the_remedy(self) -> None:
        """The error for a map that is too small contains the number of robots that fit, and a sufficient size."""
        error = self.assertRaises(SceneError, CrowdScene, 1000, 5.0, 5.0)
        self.assertIn("at most 361 fit; use at most 361 robots, or 8.4 x 8.4 m", str(error))
        self.assertEqual(CrowdScene(361, 5.0, 5.0).robots, 361)
        self.assertEqual(CrowdScene(1000, 8.4, 8.4).robots, 1000)

    def test_wrong_numbers_are_refused(self) -> None:
        """Invalid numbers of robots and invalid lengths are rejected; the error contains the valid range."""
        for bodies in (0, -1, 2.5, True, "10", MAX_ROBOTS + 1):
            self.assertIn("whole number", str(self.assertRaises(SceneError, CrowdScene, bodies, 9.0, 9.0)))
            self.assertRaises(SceneError, make_square_scene, bodies)
        for width in (0.5, math.nan, math.inf, "9", True):
            self.assertIn("width", str(self.assertRaises(SceneError, CrowdScene, 1, width, 9.0)))
        for room in (0.0, 0.01, math.nan, "4"):
            self.assertIn("room", str(self.assertRaises(SceneError, make_square_scene, 10, room)))
        self.assertIn("target_radius", str(self.assertRaises(SceneError, CrowdScene, 1, 9.0, 9.0, target_radius=2.0)))

    def test_everybody_has_a_place(self) -> None:
        """On maps of any density and shape all robots start inside the walls and without overlap."""
        for seed, (bodies, width, height) in enumerate(
            ((1, 1.0, 1.0), (361, 5.0, 5.0), (90, 40.0, 1.0), (500, 30.0, 7.0))
        ):
            crowd = Crowd(seed, CrowdScene(bodies, width, height))
            self.assertEqual(crowd.measure_overlap(), 0.0)
            self.assertTrue(((crowd.x > FOOTPRINT_RADIUS_M) & (crowd.x < width - FOOTPRINT_RADIUS_M)).all())
            self.assertTrue(((crowd.y > FOOTPRINT_RADIUS_M) & (crowd.y < height - FOOTPRINT_RADIUS_M)).all())


class ControllerTests(SynchronousTestCase):
    def run_with(self, name: str, crowd: Crowd, seconds: float) -> Readings:
        """Run a controller for some seconds; return the sensor values of the robots."""
        senses = Readings(crowd)
        for _ in range(round(seconds / TICK_S)):
            crowd.commands[:] = CONTROLLERS[name](senses)
            crowd.step()
        return senses

    def test_disperse(self) -> None:
        """``disperse`` moves robots apart that start close together: the mean of their measured ranges increases."""
        crowd = Crowd(1, CrowdScene(60, 9.0, 9.0))
        number = np.arange(60)
        crowd.x[:], crowd.y[:], crowd.heading[:] = 2.5 + 0.3 * (number % 8), 2.5 + 0.3 * (number // 8), 0.4 * number
        crowd.step()
        before = crowd.ranges.mean()
        self.run_with("disperse", crowd, 40.0)
        self.assertGreater(crowd.ranges.mean(), before + 0.4)

    def test_climb(self) -> None:
        """``climb`` leads the robots from all parts of the map to the target."""
        crowd = Crowd(1, make_square_scene(30))
        crowd.place_target_at_random()
        target = crowd.target
        assert target is not None
        self.assertGreater(float(np.median(np.hypot(crowd.x - target.x, crowd.y - target.y))), 3.0)
        self.run_with("climb", crowd, 90.0)
        self.assertLess(float(np.median(np.hypot(crowd.x - target.x, crowd.y - target.y))), 2.0)

    def test_search(self) -> None:
        """``search`` leads robots that see the target to the target, where they stop.

        The other robots continue to wander.
        """
        crowd = Crowd(1, make_square_scene(40))
        crowd.place_target_at_random()
        senses = self.run_with("search", crowd, 180.0)
        distance = senses.read_target()[1]
        self.assertGreater(int((distance < 0.45).sum()), 2)
        speed = np.hypot(crowd.vx, crowd.vy)
        self.assertLess(float(speed[distance < 0.34].max(initial=0.0)), 0.05)
        self.assertGreater(int((speed > 0.1).sum()), 10)

    def test_sight(self) -> None:
        """A robot sees a target close ahead, but not a target that is behind, far away or hidden by another robot."""
        crowd = Crowd(1, CrowdScene(5, 12.0, 12.0))
        for body, (x, y, heading) in enumerate(
            (
                (5.0, 6.0, 0.0),
                (4.0, 6.0, 0.0),
                (6.0, 5.0, 0.0),
                (6.0, 9.5, -math.pi / 2),
                (6.0, 7.0, -math.pi / 2 - 0.2),
            )
        ):
            crowd.move(body, x, y, heading)
        crowd.place_target(6.0, 6.0)
        bearing, distance = Readings(crowd).read_target()
        self.assertEqual(np.isnan(distance).tolist(), [False, True, True, True, False])
        self.assertAlmostEqual(float(distance[0]), 1.0)
        self.assertAlmostEqual(float(bearing[4]), 0.2)
        self.assertTrue(np.isnan(Readings(Crowd(1, make_square_scene(3))).read_target()[0]).all())
