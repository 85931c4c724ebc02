"""Tests of ``sim.robots.crowd.simulator``, ``sensor`` and ``camera``: drivers use a crowd robot like any other."""

from __future__ import annotations

import math
import statistics
from random import Random
from typing import Any

import numpy as np
from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from agents.vision import TargetSize, find_target
from drivers.driver import Permit
from drivers.errors import DriverError, UsageError
from drivers.reading import Observation
from drivers.sim.driver import SimDriver
from middleware.entangled.clock import HeapClock
from sim.robots.crowd.controller import stand
from sim.robots.crowd.scene import CrowdScene
from sim.robots.crowd.simulator import SPARE_CONNECTIONS, CrowdRobot, CrowdSimulator
from sim.robots.scene import FOOTPRINT_RADIUS_M, SceneError, load_scene
from sim.robots.sensor import NOSE_M
from sim.robots.simulator import RobotSimulator
from sim.robots.world import TICK_S


class DrivenTests(SynchronousTestCase):
    """Five robots on a map of 6 x 4 m; two of them are controlled by drivers."""

    def setUp(self) -> None:
        """Place the first robot at the left, facing right, and the others behind it."""
        self.clock = HeapClock()
        self.simulator = CrowdSimulator(self.clock, Random(1), CrowdScene(5, 6.0, 4.0), 2, stand)
        self.crowd = self.simulator.crowd
        for body, (x, y) in enumerate(((1.0, 2.0), (0.3, 0.3), (0.3, 3.7), (0.3, 3.0), (0.3, 1.0))):
            self.crowd.move(body, x, y, 0.0)
        self.simulator.start()

    def driver(self, name: str = "robot1", fps: float = 0.0) -> SimDriver:
        """Return a connected driver of the robot, enabled if possible."""
        driver = SimDriver({"robot": name, "camera_fps": fps}, self.simulator.connector(), self.clock)
        driver.connect().addCallback(lambda _: driver.enable()).addErrback(lambda why: why.trap(DriverError))
        self.clock.advance(0.5)
        return driver

    def newest(self, driver: SimDriver) -> Observation:
        """Return the driver's latest observation."""
        seen = driver.observe()
        assert seen is not None
        return seen

    def act(self, driver: SimDriver, seconds: float, ttl: float = 0.3, **motion: float) -> None:
        """Drive for some seconds with a command every 0.1 s."""
        for _ in range(round(seconds / 0.1)):
            permit = Permit(1, self.clock.seconds() + ttl)
            driver.act({f"base.{key}": value for key, value in motion.items()}, permit)
            self.clock.advance(0.1)

    def test_tells_what_a_dog_tells(self) -> None:
        """A crowd robot sends the same keys, value types and samples as ``RobotSimulator``, in a frame every 32 ms."""
        dogs = RobotSimulator(self.clock, Random(1), load_scene("three-dogs"))
        dogs.start()
        dog = SimDriver({"robot": "dog1"}, dogs.connector(), self.clock)
        dog.connect()
        driver = self.driver()
        here, there = self.newest(driver), self.newest(dog)
        kinds = [{key: type(value) for key, value in seen.values.items()} for seen in (here, there)]
        self.assertEqual(*kinds)
        self.assertEqual(sorted(here.samples), sorted(there.samples))
        before = driver.diagnostics()["frames"]
        self.clock.advance(100 * TICK_S)
        self.assertEqual(driver.diagnostics()["frames"] - before, 100)
        for simulator in (dogs, self.simulator):
            simulator.stop()

    def test_obeys_its_driver(self) -> None:
        """The robot and its odometry follow a command until its time to live ends; the other robots do not move."""
        driver = self.driver()
        others = self.crowd.x[1:].tolist()
        self.act(driver, 2.0, vx=0.5)
        went = float(self.crowd.x[0]) - 1.0
        self.assertAlmostEqual(went, 0.16 * 2.0, 1)
        values = self.newest(driver).values
        self.assertLess(abs(float(values["odom.x"]) - went), 0.05)
        self.assertIs(values["base.moving"], True)
        self.clock.advance(0.6)
        self.assertEqual(float(self.crowd.vx[0]), 0.0)
        self.assertEqual(self.crowd.x[1:].tolist(), others)

    def test_stands_when_nothing_is_heard(self) -> None:
        """A robot whose link falls silent but stays open stops at the end of the command's time to live."""
        connector = self.simulator.connector()
        driver = SimDriver({"robot": "robot1", "camera_fps": 0.0}, connector, self.clock)
        driver.connect().addCallback(lambda _: driver.enable())
        self.clock.advance(0.5)
        self.act(driver, 0.5, ttl=0.4, vx=0.16)
        connector.block_data()
        self.clock.advance(0.25)
        self.assertGreater(float(self.crowd.vx[0]), 0.15)
        self.clock.advance(0.5)
        self.assertEqual(float(self.crowd.vx[0]), 0.0)
        self.clock.advance(4.0)
        self.assertEqual(self.simulator.driven_robots, [])

    def test_ranges(self) -> None:
        """The near and far rangers measure from the robot's front to an obstacle, and return NaN beyond their range."""
        driver = self.driver()
        for gap, near in ((0.3, True), (1.0, False)):
            self.crowd.place_target(1.0 + NOSE_M + gap + 0.08, 2.0)
            rows: list[Observation] = []
            end = driver.subscribe(rows.append)
            self.clock.advance(1.0)
            end()
            far = statistics.fmean(float(seen.values["range.far"]) for seen in rows)
            self.assertLess(abs(far - gap), 0.005)
            self.assertEqual(math.isnan(float(rows[-1].values["range.near"])), not near)
            self.assertLess(abs(float(rows[-1].values["range.chest"]) - 0.204), 0.02)

    def test_feels_how_it_moves(self) -> None:
        """The accelerometer measures the start; compass and odometry measure the turn; the battery level falls."""
        driver = self.driver()
        felt: list[float] = []
        end = driver.subscribe(lambda seen: felt.append(float(seen.values["imu.ax"])))
        self.act(driver, 0.2, vx=0.16)
        self.assertGreater(max(felt), 0.5)
        end()
        self.act(driver, 1.0, wz=1.0)
        values = self.newest(driver).values
        self.assertLess(
            abs(math.remainder(float(values["compass.heading"]) - float(self.crowd.heading[0]), math.tau)), 0.2
        )
        self.assertLess(abs(float(values["odom.yaw"]) - float(self.crowd.heading[0])), 0.1)
        self.assertTrue(0.999 < float(values["power.level"]) < 1.0)

    def test_pictures_show_the_target(self) -> None:
        """The agents' vision locates the target in the camera pictures, unless another robot hides the target."""
        driver = self.driver(fps=10.0)
        self.crowd.place_target(3.0, 2.3)
        self.clock.advance(0.5)
        frame = self.newest(driver).frame
        assert frame is not None
        self.assertGreaterEqual(driver.diagnostics()["pictures"], 9)
        seen = find_target(frame.data, TargetSize(0.08, 0.22))
        assert seen is not None
        self.assertLess(abs(seen.bearing - math.atan2(0.3, 2.0 - NOSE_M)), 0.02)
        self.assertLess(abs(seen.distance - math.hypot(0.3, 2.0 - NOSE_M)), 0.1)
        for body, (x, y) in enumerate(((1.5, 2.08), (1.75, 2.11)), 3):
            self.crowd.move(body, x, y, 0.0)
        self.clock.advance(0.5)
        hidden = self.newest(driver).frame
        assert hidden is not None
        rest = find_target(hidden.data, TargetSize(0.08, 0.22))
        self.assertTrue(rest is None or not rest.is_whole)

    def test_pictures_without_a_target_have_no_red(self) -> None:
        """The agents' vision finds no target in pictures of walls, floor and other robots."""
        simulator = CrowdSimulator(self.clock, Random(2), CrowdScene(60, 5.0, 5.0), 60, stand)
        for name in simulator.names:
            picture = simulator.reserve_for_emulator(name).picture()
            assert picture is not None
            self.assertIsNone(find_target(picture, TargetSize(0.08, 0.22)))

    def test_body_for_an_emulator(self) -> None:
        """A robot that is lent to an emulator moves, stops, senses and detects bumps. Drivers cannot control it."""
        robot = self.simulator.reserve_for_emulator("robot2")
        robot.drive(0.16, 0.0, 0.0)
        self.clock.advance(1.0)
        self.assertGreater(float(self.crowd.x[1]), 0.4)
        robot.drive(math.nan, 0.0, 0.0)
        self.clock.advance(0.5)
        self.assertEqual(float(self.crowd.vx[1]), 0.0)
        self.assertEqual(self.bumps(robot), (False, False))
        self.crowd.move(2, float(self.crowd.x[1]) + 2 * FOOTPRINT_RADIUS_M, 0.3, 0.0)
        self.assertEqual(self.bumps(robot), (True, True))
        self.crowd.move(1, 3.0, FOOTPRINT_RADIUS_M, math.radians(-60.0))
        self.assertEqual(self.bumps(robot), (False, True))
        self.crowd.move(1, 3.0, 2.0, 0.0)
        self.crowd.place_target(3.0 + FOOTPRINT_RADIUS_M + 0.08, 2.0)
        self.assertEqual(self.bumps(robot), (True, True))
        self.assertIn("odom.x", robot.sense())
        robot.halt()
        self.assertEqual(self.driver("robot2").state, "closed")
        self.assertRaises(UsageError, self.simulator.reserve_for_emulator, "robot3")

    def bumps(self, body: CrowdRobot) -> tuple[Any, Any]:
        """Return the values of the left and right bump sensors."""
        values = body.sense()
        return values["bump.left"], values["bump.right"]

    def test_wrong_numbers_are_refused(self) -> None:
        """An invalid number of drivers is rejected, and so is a connection beyond the limit.

        A driver for a robot that is not controlled by a driver is also rejected.
        """
        for driven in (-1, 6, 1.5, True):
            self.assertRaises(SceneError, CrowdSimulator, self.clock, Random(1), CrowdScene(5, 6.0, 4.0), driven)
        self.assertEqual(self.driver("robot3").state, "closed")
        connector = self.simulator.connector()
        callers = [SimDriver({"robot": "robot1"}, connector, self.clock) for _ in range(2 + SPARE_CONNECTIONS + 1)]
        for caller in callers:
            caller.connect().addErrback(lambda why: None)
        self.clock.advance(0.05)
        self.assertEqual(callers[-1].diagnostics()["refused"], 1)

    def test_costs_are_counted_apart(self) -> None:
        """The stopwatch measures the time for motion separately from the time for observations."""
        moments = iter(np.arange(0.0, 1000.0, 1.0).tolist())
        simulator = CrowdSimulator(self.clock, Random(1), CrowdScene(5, 6.0, 4.0), 1, stand, lambda: next(moments))
        simulator.start()
        self.clock.advance(TICK_S * 10.5)
        self.assertEqual((simulator.moving_s, simulator.reporting_s), (10.0, 10.0))

    def test_time_lost_is_not_made_up_for(self) -> None:
        """After a pause of the machine the simulation does not catch up, and drops commands from before the pause."""
        clock = Clock()
        simulator = CrowdSimulator(clock, Random(1), CrowdScene(5, 6.0, 4.0), 1, stand)
        simulator.start()
        simulator.drive("robot1", 0.16, 0.0, 0.0)
        clock.advance(TICK_S)
        self.assertGreater(float(simulator.crowd.commands[0, 0]), 0.0)
        clock.advance(5.0)
        self.assertEqual((simulator.crowd.ticks, float(simulator.crowd.commands[0, 0])), (2, 0.0))
        clock.advance(TICK_S)
        self.assertEqual(simulator.crowd.ticks, 3)
        simulator.stop()
        clock.advance(1.0)
        self.assertEqual(simulator.crowd.ticks, 3)
