"""Tests of ``sim.robots.sensor``."""

from __future__ import annotations

import math
import statistics
from random import Random

from twisted.trial.unittest import SynchronousTestCase

from sim.robots.scene import load_scene
from sim.robots.sensor import NOSE_M, Sensors
from sim.robots.world import SUBSTEP_S, World


class SensorsTests(SynchronousTestCase):
    """The sensors of dog1."""

    def setUp(self) -> None:
        """Place dog1 in the middle, facing right, and dog2 out of the range of dog1's sensors."""
        self.world = World(Random(1), load_scene("three-dogs"))
        self.world.move_dog("dog2", 2.6, 2.1, 0.0)
        self.world.move_dog("dog1", 1.0, 1.0, 0.0)
        self.sensors = Sensors(Random(2), self.world, self.world.dogs["dog1"])

    def run_for(self, seconds: float) -> dict[str, list[float]]:
        """Run for some seconds; return all samples."""
        rows: dict[str, list[float]] = {}
        for _ in range(round(seconds / SUBSTEP_S / 4)):
            for _ in range(4):
                self.world.step()
                self.sensors.sample()
            for key, row in self.sensors.pop_samples().items():
                self.assertEqual(len(row), 4)
                rows.setdefault(key, []).extend(row)
        return rows

    def mean_range(self, key: str, gap: float) -> float:
        """Return the mean range with the target ``gap`` metres ahead; NaN if all samples are NaN."""
        self.world.place_target(1.0 + NOSE_M + gap + 0.08, 1.0)
        row = self.run_for(0.4)[key]
        self.assertTrue(all(math.isnan(x) for x in row) or not any(math.isnan(x) for x in row))
        return statistics.fmean(row)

    def test_ranges_within_the_reach_of_each_ranger(self) -> None:
        """The near ranger measures 0.05 to 0.5 m, the far ranger 0.2 to 1.5 m.

        A shorter distance is reported as the minimum, a longer distance as NaN.
        """
        for gap in (0.1, 0.3, 0.45):
            self.assertLess(abs(self.mean_range("range.near", gap) - gap), 0.003)
        self.assertAlmostEqual(self.mean_range("range.near", 0.02), 0.05, 3)
        self.assertTrue(math.isnan(self.mean_range("range.near", 0.6)))
        for gap in (0.3, 0.9, 1.4):
            self.assertLess(abs(self.mean_range("range.far", gap) - gap), 0.006)
        self.assertAlmostEqual(self.mean_range("range.far", 0.1), 0.2, 3)
        self.world.clear_target()
        self.assertTrue(all(math.isnan(x) for x in self.run_for(0.1)["range.far"]))

    def test_sees_the_floor_with_the_chest(self) -> None:
        """The range sensor on the chest measures 0.20 m to the floor, and less if an obstacle is at the feet."""
        self.assertLess(abs(statistics.fmean(self.run_for(0.4)["range.chest"]) - 0.204), 0.003)
        self.assertLess(self.mean_range("range.chest", 0.12), 0.15)

    def test_feels_gravity_and_its_own_start(self) -> None:
        """At rest the accelerometer measures gravity, positive upwards.

        The value in x is positive when the dog starts to walk, and negative when it stops.
        """
        rows = self.run_for(1.0)
        self.assertLess(abs(statistics.fmean(rows["imu.az"]) - 9.80665), 0.05)
        self.assertLess(abs(statistics.fmean(rows["imu.ax"])), 0.05)
        self.world.drive("dog1", 0.16, 0.0, 0.0)
        self.assertGreater(statistics.fmean(self.run_for(0.16)["imu.ax"]), 0.5)
        self.run_for(0.5)
        self.world.halt("dog1")
        self.assertLess(statistics.fmean(self.run_for(0.032)["imu.ax"]), -1.0)

    def test_reckons_its_way_with_a_drift(self) -> None:
        """Odometry follows the walk within 8 % but not exactly; the battery discharges faster during a walk."""
        self.run_for(6.0)
        rested = 1.0 - float(self.sensors.values()["power.level"])
        self.world.drive("dog1", 0.16, 0.0, 0.0)
        self.run_for(6.0)
        self.assertGreater(1.0 - float(self.sensors.values()["power.level"]) - rested, 1.5 * rested)
        self.assertGreater(rested, 0.0)
        walked = self.world.dogs["dog1"].x - 1.0
        felt = float(self.sensors.values()["odom.x"])
        self.assertLess(abs(felt - walked), 0.08 * walked)
        self.assertNotEqual(felt, walked)
