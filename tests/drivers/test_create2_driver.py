"""Tests of ``drivers.create2.driver`` against ``sim.robots.emulator.create2``, connected in memory."""

from __future__ import annotations

import math
from random import Random

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from drivers.conformance import Conformance
from drivers.create2 import codec
from drivers.errors import LinkLost, NoReply, NotEnabled, Unsupported, UsageError
from drivers.link import MemoryConnector
from sim.robots.emulator.create2 import Create2
from sim.robots.emulator.simulated_robot import MemoryRobot
from tests.drivers.contract import RobotCase


class Create2Case(RobotCase):
    """A Create 2 on a serial port in memory."""

    kind = "create2"
    options = {"port": "memory"}

    def build(self) -> None:
        self.robot = Create2(self.body, self.clock, Random(1))
        self.faults = self.robot.faults
        self.connector = MemoryConnector(self.clock, self.robot.accept)


class Create2DriverTests(Conformance, Create2Case):
    """The Create 2 driver passes the conformance tests and further tests of its functions."""

    def test_tells_what_it_feels(self) -> None:
        """Bumpers, cliffs, wheel drops, light, battery and mode arrive under the keys of their capabilities."""
        self.body.values |= {"bump.left": True, "cliff.front_right": True, "power.level": 0.5, "range.near": 0.1}
        driver = self.connected()
        self.assertEqual((self.value(driver, "bump.left"), self.value(driver, "bump.right")), (True, False))
        self.assertIs(self.value(driver, "cliff.front_right"), True)
        self.assertAlmostEqual(float(self.value(driver, "power.level")), 0.5, places=3)
        self.assertEqual((self.value(driver, "mode"), self.value(driver, "estop.engaged")), ("passive", True))
        self.assertGreater(float(self.value(driver, "lightbump.center_left")), 0.5)
        self.assertEqual(self.value(driver, "lightbump.left"), 0.0)

    def test_counts_its_way_over_the_end_of_the_counters(self) -> None:
        """The odometry follows the robot while the encoders wrap."""
        self.robot.left = self.robot.right = 65_500.0
        driver = self.ready()
        driver.act({"base.vx": 0.2, "base.wz": 0.5}, self.permit(seconds=3.0))
        self.pass_time(2.0)
        self.near(self.value(driver, "odom.x"), self.body.x, 0.01)
        self.near(self.value(driver, "odom.y"), self.body.y, 0.01)
        self.near(self.value(driver, "odom.yaw"), self.body.yaw, 0.02)
        self.near(self.value(driver, "base.vx"), 0.2, 0.01)
        self.near(self.value(driver, "base.wz"), 0.5, 0.05)
        self.assertEqual(driver.diagnostics()["jumps"], 0)

    def test_slows_both_wheels_where_one_would_be_too_fast(self) -> None:
        """In a curve above the maximum wheel speed both wheels slow down, so the radius stays.

        ``act`` shows the result.
        """
        driver = self.ready()
        done = driver.act({"base.vx": 0.5, "base.wz": 2.0}, self.permit())
        self.assertLess(done["base.vx"], 0.4)
        self.assertTrue(math.isclose(done["base.wz"] / done["base.vx"], 4.0, abs_tol=0.05))
        self.pass_time(0.05)
        self.assertAlmostEqual(self.body.motion[0], done["base.vx"])
        self.assertAlmostEqual(self.body.motion[2], done["base.wz"])

    def test_stays_off_after_a_safety_event(self) -> None:
        """A lifted wheel stops the robot and is reported; the motors stay off until ``enable``."""
        driver = self.ready()
        driver.act({"base.vx": 0.2}, self.permit(seconds=5.0))
        self.pass_time(0.2)
        self.body.values["wheeldrop.left"] = True
        self.pass_time(0.1)
        self.assertLess(self.true_speed(), 0.01)
        self.assertEqual(self.value(driver, "safety.event"), "wheeldrop.left")
        self.assertEqual((driver.state, driver.diagnostics()["safety_events"]), ("stopped", 1))
        self.body.values["wheeldrop.left"] = False
        self.pass_time(1.0)
        self.assertEqual(self.robot.mode, 1)
        self.assertRaises(NotEnabled, driver.act, {"base.vx": 0.1}, self.permit())
        self.cut_link()
        self.pass_time(1.0)
        self.assertEqual(self.robot.mode, 1)
        enabled = driver.enable()
        self.pass_time(0.1)
        self.assertIs(self.successResultOf(enabled), True)
        self.assertEqual(self.value(driver, "safety.event"), "")
        driver.act({"base.vx": 0.1}, self.permit())

    def test_full_mode_has_no_guards(self) -> None:
        """In full mode, which an option selects, a cliff does not stop the robot."""
        self.body.values["cliff.left"] = True
        driver = self.ready(mode="full")
        self.assertEqual(self.value(driver, "mode"), "full")
        driver.act({"base.vx": 0.1}, self.permit())
        self.pass_time(0.1)
        self.assertGreater(self.true_speed(), 0.05)

    def test_says_when_it_cannot_be_enabled(self) -> None:
        """With a lifted wheel the robot does not enter safe mode, and ``enable`` fails with NoReply."""
        self.body.values["wheeldrop.right"] = True
        driver = self.connected()
        enabled = driver.enable()
        self.pass_time(1.1)
        self.failureResultOf(enabled, NoReply)

    def test_docks(self) -> None:
        """The skill ``dock`` completes when the robot charges; the motors are then off, which is not a safety event."""
        driver = self.ready()
        docked = driver.invoke("dock")
        self.pass_time(0.5)
        self.assertNoResult(docked)
        self.assertGreater(self.true_speed(), 0.05)
        self.assertEqual(self.value(driver, "skill.running"), "dock")
        self.failureResultOf(driver.invoke("dock"), UsageError)
        self.body.values["power.charging"] = True
        self.pass_time(0.1)
        self.assertEqual(self.successResultOf(docked), {"dock.on": True})
        self.assertLess(self.true_speed(), 0.01)
        self.assertEqual((driver.state, self.value(driver, "safety.event")), ("stopped", ""))
        self.assertIs(self.value(driver, "power.charging"), True)

    def test_docking_can_be_stopped(self) -> None:
        """A stop, a cancellation, a lost link and a timeout each end the skill ``dock``."""
        driver = self.ready()
        docking = driver.invoke("dock")
        self.pass_time(0.2)
        driver.stop()
        self.pass_time(0.1)
        self.failureResultOf(docking, NotEnabled)
        self.assertLess(self.true_speed(), 0.01)
        self.assertEqual(self.robot.mode, 1)
        for end, error in ((lambda: self.pass_time(121.0), NoReply), (self.connector.cut, LinkLost)):
            driver.enable()
            self.pass_time(0.1)
            docking = driver.invoke("dock")
            self.pass_time(0.1)
            end()
            self.failureResultOf(docking, error)
            self.pass_time(0.5)
            self.assertLess(self.true_speed(), 0.01)
        driver.enable()
        self.pass_time(0.1)
        docking = driver.invoke("dock")
        docking.addErrback(lambda _: None)
        docking.cancel()
        self.pass_time(0.1)
        self.assertLess(self.true_speed(), 0.01)

    def test_beeps(self) -> None:
        """``beep`` plays the note that is nearest to the requested frequency, and returns the frequency of this note.

        Invalid arguments and unknown skills are refused.
        """
        driver = self.make_driver()
        self.failureResultOf(driver.invoke("beep"), LinkLost)
        driver.connect()
        self.pass_time(0.2)
        self.failureResultOf(driver.invoke("beep"), NotEnabled)
        self.failureResultOf(driver.invoke("dock"), NotEnabled)
        driver.enable()
        self.pass_time(0.1)
        self.assertAlmostEqual(float(self.successResultOf(driver.invoke("beep", hz=445.0))["beep.hz"]), 440.0)
        self.pass_time(0.05)
        self.assertEqual(self.robot.played_songs, [0])
        self.failureResultOf(driver.invoke("beep", hz="high"), Unsupported)
        self.failureResultOf(driver.invoke("beep", tune="march"), Unsupported)
        self.failureResultOf(driver.invoke("dock", fast=1.0), Unsupported)
        self.failureResultOf(driver.invoke("fly"), Unsupported)

    def test_starts_a_rebooted_robot_again(self) -> None:
        """After a reboot during a drive, the driver starts the robot again, at rest and without an odometry jump."""
        driver = self.ready()
        driver.act({"base.vx": 0.2}, self.permit(seconds=9.0))
        self.pass_time(1.0)
        x = float(self.value(driver, "odom.x"))
        self.robot.reboot()
        self.pass_time(0.4)
        self.assertEqual(driver.state, "stale")
        self.pass_time(4.0)
        self.assertEqual((driver.state, driver.problem), ("ready", ""))
        self.assertLess(self.true_speed(), 0.01)
        self.near(self.value(driver, "odom.x"), x, 0.05)
        driver.act({"base.vx": 0.1}, self.permit())

    def test_takes_nothing_from_before_its_start(self) -> None:
        """Frames sent before the start command arrives cause no safety event; the motors are enabled again."""
        self.connector = MemoryConnector(self.clock, self.robot.accept, delay=0.02)
        driver = self.ready()
        self.cut_link()
        self.pass_time(2.0)
        self.assertEqual((driver.state, self.robot.mode, driver.diagnostics()["safety_events"]), ("ready", 2, 0))

    def test_stops_a_robot_that_it_no_longer_hears(self) -> None:
        """If the robot receives but sends nothing, the driver stops it within a second and sets ``problem``."""
        driver = self.ready()
        driver.act({"base.vx": 0.2}, self.permit(seconds=9.0))
        self.pass_time(0.2)
        self.faults.half_open = True
        self.pass_time(1.0)
        self.assertEqual(driver.state, "stale")
        self.assertLess(self.true_speed(), 0.01)
        self.assertIn("switched on", driver.problem)
        self.faults.half_open = False
        self.pass_time(5.0)
        self.assertEqual(driver.state, "ready")

    def test_names_a_wrong_baud_rate(self) -> None:
        """Bytes without a valid frame are reported as a possibly wrong baud rate."""
        self.faults.garbage = 1.0
        driver = self.make_driver()
        connected = driver.connect()
        self.pass_time(2.0)
        self.assertNoResult(connected)
        self.assertIn("115200 baud", driver.problem)
        self.faults.garbage = 0.0
        self.pass_time(5.0)
        self.successResultOf(connected)
        self.assertGreater(driver.diagnostics()["bad_frames"], 2)

    def test_lives_with_a_foul_wire(self) -> None:
        """If a tenth of the frames is lost and a tenth is invalid, delayed or split, the driver still works.

        The driver counts the invalid frames.
        """
        driver = self.ready()
        self.faults.drop = self.faults.garbage = 0.1
        self.faults.split, self.faults.delay = True, 0.02
        driver.act({"base.vx": 0.2}, self.permit(seconds=9.0))
        self.pass_time(3.0)
        self.assertEqual(driver.state, "ready")
        self.near(self.value(driver, "odom.x"), self.body.x, 0.05)
        numbers = driver.diagnostics()
        self.assertGreater(numbers["bad_frames"], 5)
        self.assertGreater(numbers["frames"], 100)
        self.assertEqual(numbers["reconnects"], 0)


class EmulatorTests(SynchronousTestCase):
    """Functions of the emulator that this driver does not use."""

    def setUp(self) -> None:
        self.clock = Clock()
        self.body = MemoryRobot()
        self.robot = Create2(self.body, self.clock, Random(1))
        self.said = b""
        self.connector = MemoryConnector(self.clock, self.robot.accept)
        self.link = self.connector.open_pair(self)
        self.addCleanup(self.robot.stop)

    def data_received(self, data: bytes) -> None:
        self.said += data

    def link_down(self) -> None:
        """Do nothing."""

    def tell(self, data: bytes) -> bytes:
        """Send ``data`` and return the data that the robot sends within 10 ms."""
        assert self.link is not None
        self.said = b""
        self.link.send(data)
        self.clock.pump([0.001] * 10)
        return self.said

    def test_is_off_until_it_is_started(self) -> None:
        """Until the start command the robot ignores all data; afterwards it is in passive mode and does not drive."""
        self.assertEqual(self.tell(bytes((142, 35))), b"")
        self.assertEqual(self.tell(bytes((128, 142, 35))), b"\x01")
        self.tell(codec.encode_drive_direct(100, 100))
        self.assertEqual(self.body.motion, (0.0, 0.0, 0.0))
        self.assertEqual(self.tell(bytes((131, 142, 35))), b"\x02")
        self.assertEqual(self.tell(bytes((132, 142, 35))), b"\x03")
        self.assertEqual(self.tell(bytes((135, 142, 35))), b"\x01")

    def test_answers_groups_and_lists(self) -> None:
        """Group 100 has 80 bytes; the reply to a list has no packet ids, and omits unknown packets."""
        self.assertEqual(len(self.tell(bytes((128, 142, 100)))), 80)
        self.assertEqual(len(self.tell(codec.encode_query((35, 22, 200, 43)))), 5)

    def test_drives_on_arcs(self) -> None:
        """Straight, spin and arc commands move the robot as specified."""
        self.tell(bytes((128, 131)) + codec.encode_drive(200, codec.STRAIGHT_RADIUS))
        self.assertEqual(self.body.motion, (0.2, 0.0, 0.0))
        self.tell(codec.encode_drive(235, 1))
        self.assertEqual(self.body.motion, (0.0, 0.0, 2.0))
        self.tell(codec.encode_drive(235, -1))
        self.assertEqual(self.body.motion, (0.0, 0.0, -2.0))
        self.tell(codec.encode_drive(100, 1000))
        self.assertTrue(math.isclose(self.body.motion[2], 0.1, abs_tol=0.01))

    def test_a_ledge_stops_it_ahead_only(self) -> None:
        """In safe mode a cliff stops forward motion but not backward motion."""
        self.body.values["cliff.left"] = True
        self.tell(bytes((128, 131)) + codec.encode_drive_direct(-100, -100))
        self.assertEqual(self.body.motion[0], -0.1)
        self.tell(codec.encode_drive_direct(100, 100))
        self.assertEqual((self.body.motion[0], self.robot.mode), (0.0, 1))

    def test_reset_says_its_firmware(self) -> None:
        """After a reset the robot sends its boot text, is off, and sends no stream."""
        self.tell(bytes((128,)) + codec.encode_stream((35,)))
        self.clock.pump([0.015] * 4)
        self.assertIn(b"\x13\x02\x23\x01", self.said)
        self.tell(bytes((7,)))
        self.said = b""
        self.clock.pump([0.01] * 110)
        self.assertIn(b"release-3.5.4", self.said)
        self.assertEqual(self.robot.mode, 0)
        self.assertNotIn(b"\x13\x02\x23", self.said)
