"""Tests of ``sim.robots.emulated_robots`` and ``emulator.dog``: simulated dogs that emulate other kinds of robots."""

from __future__ import annotations

import math
import os
from pathlib import Path
from random import Random
from typing import Any

from twisted.internet.task import Clock
from twisted.internet.testing import MemoryReactorClock
from twisted.trial.unittest import SynchronousTestCase

from drivers.errors import UsageError
from drivers.registry import describe
from formats.jpeg import read_size
from sim.robots.dog import LIMITS
from sim.robots.emulated_robots import EmulatedRobots
from sim.robots.emulator.bittle import Bittle
from sim.robots.emulator.dog import SimulatedDog
from sim.robots.emulator.pty import PtyPort
from sim.robots.emulator.simulated_robot import MemoryRobot
from sim.robots.scene import load_scene
from sim.robots.simulator import RobotSimulator
from sim.robots.world import TICK_S


class SimulatorCase(SynchronousTestCase):
    """A running simulator in virtual time."""

    def setUp(self) -> None:
        self.clock = Clock()
        self.simulator = RobotSimulator(self.clock, Random(1), load_scene("three-dogs"))
        self.simulator.start()

    def pass_time(self, seconds: float) -> None:
        """Advance the clock, one tick of the simulator at a time."""
        for _ in range(round(seconds / TICK_S)):
            self.clock.advance(TICK_S)


class SimulatedDogTests(SimulatorCase):
    """``SimulatedDog`` moves a lent dog and reads its sensors."""

    def lent(self, limits: Any = LIMITS) -> SimulatedDog:
        """Return the emulated robot that moves dog1, which faces the middle of the map."""
        return self.simulator.reserve_for_emulator("dog1", limits)

    def test_moves_as_fast_as_its_kind(self) -> None:
        """The body obeys the limits of the kind that it emulates, and stops on a halt."""
        body = self.lent({"base.vx": (-0.5, 0.5), "base.wz": (-4.25, 4.25)})
        body.drive(0.9, 0.2, 0.0)
        self.pass_time(1.0)
        sensed = body.sense()
        self.assertAlmostEqual(float(sensed["base.vx"]), 0.5, places=2)
        self.assertAlmostEqual(float(sensed["base.vy"]), 0.0, places=2)
        body.halt()
        self.pass_time(1.0)
        self.assertFalse(body.sense()["base.moving"])

    def test_stands_where_it_is_told_no_number(self) -> None:
        """A velocity that is NaN or infinite stops the dog, and its position stays finite."""
        body = self.lent()
        for motion in ((math.nan, 0.0, 0.0), (0.0, -math.inf, 0.0), (0.0, 0.0, math.nan)):
            body.drive(0.1, 0.0, 0.0)
            self.pass_time(0.5)
            body.drive(*motion)
            self.pass_time(1.0)
            self.assertFalse(body.sense()["base.moving"])
            self.assertTrue(math.isfinite(self.simulator.world.dogs["dog1"].x))

    def test_senses(self) -> None:
        """Sensors can be read at any time, bumpers detect walls ahead and at the side, and pictures have two sizes."""
        body = self.lent()
        self.pass_time(0.5)
        sensed = body.sense()
        for key in ("imu.ax", "imu.az", "odom.x", "power.level"):
            self.assertTrue(math.isfinite(float(sensed[key])), key)
        self.assertEqual((sensed["bump.left"], sensed["bump.right"]), (False, False))
        for heading, wanted in ((180.0, (True, True)), (135.0, (True, False)), (-135.0, (False, True))):
            self.simulator.world.move_dog("dog1", 0.2, 1.2, math.radians(heading))
            body.drive(0.16, 0.0, 0.0)
            self.pass_time(1.5)
            sensed = body.sense()
            self.assertEqual((sensed["bump.left"], sensed["bump.right"]), wanted, str(heading))
        self.assertEqual(read_size(body.picture() or b""), (208, 160))
        self.assertEqual(read_size(body.picture(True) or b""), (104, 80))


class RobotsTests(SimulatorCase):
    """The table of robots is validated, and each dog accepts only one kind of connection."""

    def test_lent_dog_has_no_other_driver(self) -> None:
        """A dog that is lent to an emulator rejects the driver of simulated dogs."""
        from drivers.sim.driver import SimDriver

        self.simulator.reserve_for_emulator("dog1", describe("create2", {"port": "x"}).limits)
        driver = SimDriver({"robot": "dog1"}, self.simulator.connector(), self.clock)
        failed = driver.connect()
        self.pass_time(0.5)
        self.assertIn("emulates a robot of another kind", self.failureResultOf(failed).getErrorMessage())

    def test_refuses_what_it_cannot_play(self) -> None:
        """An unknown dog, a kind without emulator, an unknown dialect and invalid options are rejected.

        The error contains the invalid name.
        """
        aibo = {"kind": "aibo", "options": {"host": "127.0.0.1"}}
        cases: list[tuple[dict[str, Any], str]] = [
            ({"dog9": aibo}, "no robot is named 'dog9'.*it has dog1, dog2, dog3"),
            ({"dog1": {"kind": "phone"}}, "no robot of kind 'phone'.*it has aibo"),
            ({"dog1": {**aibo, "dialect": "T9"}}, "dialect is 'T9', but must be one of T4, T2"),
            ({"dog1": {"kind": "aibo", "options": {"port": 1}}}, "option port is unknown"),
            ({"dog1": {"kind": "aibo", "options": 7}}, r"\[dog1\] options must be a table"),
            ({"dog1": {**aibo, "parts": 7}}, r"\[dog1\] parts must be tables"),
            ({"dog1": {**aibo, "parts": [{"options": {}}]}}, r"\[dog1\] parts must be tables"),
            ({"dog1": {**aibo, "parts": [{"kind": "camera"}]}}, r"\[dog1\] an emulated camera needs the option url"),
            ({"dog1": {**aibo, "parts": [{"kind": "compass"}]}}, r"\[dog1\] part 1: .* option host .* or device"),
            ({"dog1": {**aibo, "dialct": "T2"}}, r"\[dog1\] has an unknown key 'dialct'; known are kind, options"),
            ({"dog1": 7}, r"\[dog1\] must have a kind"),
        ]
        for table, problem in cases:
            with self.assertRaisesRegex(UsageError, problem):
                EmulatedRobots(self.clock, Random(1), self.simulator, table)

    def test_replaces_no_file(self) -> None:
        """A file at the path of the serial port is kept and reported; only the link of an earlier run is replaced."""
        folder = Path(self.mktemp())
        folder.mkdir()
        path = folder / "ttyUSB0"
        table = {"dog1": {"kind": "create2", "options": {"port": str(path)}}}
        path.write_text("a device, or somebody's notes")
        robots = EmulatedRobots(MemoryReactorClock(), Random(1), self.simulator, table)
        with self.assertRaisesRegex(UsageError, r"\[dog1\] .*ttyUSB0 already exists"):
            robots.start()
        robots.stop()
        self.assertEqual(path.read_text(), "a device, or somebody's notes")
        path.unlink()
        path.symlink_to("/dev/pts/99999")
        port = PtyPort(MemoryReactorClock(), Bittle(MemoryRobot(), self.clock, Random(1)).accept, str(path))
        self.assertNotEqual(str(path.readlink()), "/dev/pts/99999")
        # If another program has put a link at the path, the link is kept.
        path.unlink()
        path.symlink_to("elsewhere")
        port.close()
        self.assertEqual(str(path.readlink()), "elsewhere")

    def test_names_whose_address_cannot_be_had(self) -> None:
        """A robot that cannot be served is reported with the reason; no file stays open."""
        before = len(os.listdir("/dev/fd"))
        table = {"dog2": {"kind": "create2", "options": {"port": "/nowhere/at/all"}}}
        robots = EmulatedRobots(MemoryReactorClock(), Random(1), self.simulator, table)
        with self.assertRaisesRegex(UsageError, r"\[dog2\] the emulator cannot listen: .*/nowhere/at/all"):
            robots.start()
        robots.stop()
        self.assertEqual(len(os.listdir("/dev/fd")), before)
