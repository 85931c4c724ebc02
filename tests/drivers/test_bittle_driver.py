"""Tests of ``drivers.bittle.driver`` against ``sim.robots.emulator.bittle``, over a serial port and Wi-Fi."""

from __future__ import annotations

import contextlib
import math
from random import Random

from drivers.bittle import gait
from drivers.bittle.driver import BittleDriver
from drivers.conformance import Conformance
from drivers.errors import LinkLost, NotEnabled, Unsupported
from drivers.link import MemoryConnector
from sim.robots.emulator.bittle import BEHAVIOUR_S, UNSUPPORTED_TOKENS, Bittle
from tests.drivers.contract import KeptLink, RobotCase

GAITS = {"wkF": [0.1, 0.0], "trF": [0.15, 0.0], "bk": [-0.05, 0.0], "vtL": [0.0, 0.5], "vtR": [0.0, -0.5]}
"""Measured gaits, one of which has exactly the 0.1 m/s that the conformance tests command."""


class BittleCase(RobotCase):
    """A dog on a serial port."""

    END_S = 2.0
    kind = "bittle"
    options = {"port": "memory", "gaits": GAITS}
    board = "biboard"
    resets = False

    def build(self) -> None:
        gaits = {**gait.GAITS, "wkF": gait.Velocity(0.1, 0.0)}
        self.robot = Bittle(self.body, self.clock, Random(1), self.board, self.resets, gaits)
        self.faults = self.robot.faults
        self.connector = MemoryConnector(self.clock, self.robot.accept)

    def tearDown(self) -> None:
        """Check that no command was sent that changes the robot permanently."""
        super().tearDown()
        self.assertEqual([one for one in self.robot.received_commands if chr(one[0]) in UNSUPPORTED_TOKENS], [])


class BittleDriverTests(Conformance, BittleCase):
    """The driver of a Bittle on a serial port passes the conformance tests and further tests of its functions."""

    def test_returns_the_gait_that_it_really_has(self) -> None:
        """``act`` returns the velocity of the nearest gait, and the dog moves at this velocity."""
        driver = self.ready()
        self.assertEqual(driver.act({"base.vx": 0.06, "base.wz": 0.05}, self.permit()), {"base.vx": 0.1, "base.wz": 0})
        self.pass_time(0.1)
        self.assertEqual(self.body.motion, (0.1, 0.0, 0.0))
        self.assertEqual(driver.act({"base.vx": 0.0, "base.wz": 0.3}, self.permit()), {"base.vx": 0, "base.wz": 0.5})
        self.pass_time(0.1)
        self.assertEqual(self.body.motion, (0.0, 0.0, 0.5))
        self.assertEqual(self.value(driver, "skill.running"), "vtL")

    def test_asks_for_a_gait_once(self) -> None:
        """A repeated action sends its command only once, because each command restarts the gait in the firmware."""
        driver = self.ready()
        for _ in range(10):
            driver.act({"base.vx": 0.1}, self.permit())
            self.pass_time(0.1)
        self.assertEqual(self.robot.received_commands.count(b"kwkF"), 1)

    def test_tells_what_it_feels(self) -> None:
        """Attitude, joints, distance and battery arrive in SI units."""
        self.body.values |= {"imu.roll": 0.2, "range.near": 0.5, "power.level": 0.5}
        self.robot.joints[0], self.robot.joints[8] = 30, -45
        driver = self.ready(ultrasonic=[16, 17])
        self.pass_time(3.0)
        self.near(self.value(driver, "imu.roll"), 0.2, 0.01)
        self.assertAlmostEqual(self.value(driver, "joint.head_pan.pos"), math.radians(30))
        self.assertAlmostEqual(self.value(driver, "joint.lf_shoulder.pos"), math.radians(-45))
        self.assertEqual(self.value(driver, "range.front"), 0.5)
        self.assertAlmostEqual(self.value(driver, "power.volts"), 7.6)
        self.assertAlmostEqual(self.value(driver, "power.level"), 0.5)
        self.assertEqual(self.value(driver, "mode"), "biboard")

    def test_reckons_where_it_is(self) -> None:
        """The pose is estimated from the executed gaits."""
        driver = self.ready()
        driver.act({"base.vx": 0.1}, self.permit(seconds=2.0))
        self.pass_time(2.5)
        self.near(self.value(driver, "odom.x"), self.body.x, 0.02)

    def test_does_skills(self) -> None:
        """A skill ends without a command; until then the driver refuses actions and stays ready.

        The names of gaits are not accepted as skills.
        """
        driver = self.ready()
        driver.act({"base.vx": 0.1}, self.permit(seconds=5.0))
        self.pass_time(0.2)
        done = driver.invoke("hi")
        self.pass_time(BEHAVIOUR_S - 0.2)
        self.assertNoResult(done)
        self.assertEqual((driver.state, self.true_speed()), ("ready", 0.0))
        self.assertRaises(NotEnabled, driver.act, {"base.vx": 0.1}, self.permit())
        self.failureResultOf(driver.invoke("sit"), NotEnabled)
        self.pass_time(0.4)
        self.assertEqual(self.successResultOf(done), {"skill.done": "hi"})
        driver.act({"base.vx": 0.1}, self.permit())
        self.pass_time(0.1)
        self.assertGreater(self.true_speed(), 0.05)
        self.failureResultOf(driver.invoke("wkF"), Unsupported)
        self.failureResultOf(driver.invoke("sit", fast=1.0), Unsupported)
        self.pass_time(1.0)

    def test_turns_joints(self) -> None:
        """Joints are set by name in radians, within their limits; invalid arguments are refused."""
        driver = self.ready()
        turned = driver.invoke("joint", head_pan=0.5, lf_knee=9.0)
        self.pass_time(0.1)
        self.successResultOf(turned)
        self.assertEqual((self.robot.joints[0], self.robot.joints[12]), (29, 200))
        for arguments in ({}, {"tail": 0.1}, {"head_pan": math.nan}, {"head_pan": "left"}):
            self.failureResultOf(driver.invoke("joint", **arguments), Unsupported)

    def test_refuses_skills_of_a_dog_that_lies(self) -> None:
        """A dog without a link, or with its servos off, refuses skills."""
        driver = self.make_driver()
        self.failureResultOf(driver.invoke("sit"), LinkLost)
        driver.connect()
        self.pass_time(0.3)
        self.failureResultOf(driver.invoke("sit"), NotEnabled)
        driver.stop()
        self.pass_time(0.2)
        self.assertTrue(self.robot.is_limp)

    def test_asks_again_for_a_gait_whose_answer_was_lost(self) -> None:
        """A stop that the dog does not confirm within a second is repeated."""
        driver = self.ready()
        self.faults.half_open = True
        driver.stop()
        self.pass_time(1.3)
        self.assertGreaterEqual(self.robot.received_commands.count(b"kup"), 3)

    def test_takes_up_a_rebooted_dog(self) -> None:
        """After a reboot during a walk the driver reads the banner, and the dog stands up, ready and at rest."""
        driver = self.ready()
        driver.act({"base.vx": 0.1}, self.permit(seconds=9.0))
        self.pass_time(0.5)
        self.robot.reboot()
        self.pass_time(1.3)
        self.assertEqual(driver.state, "stale")
        self.pass_time(3.0)
        self.assertEqual((driver.state, driver.problem, self.true_speed()), ("ready", "", 0.0))
        self.assertIs(self.robot.is_limp, False)
        self.assertEqual(driver.diagnostics()["reconnects"], 1)
        driver.act({"base.vx": 0.1}, self.permit())
        self.pass_time(0.1)
        self.assertGreater(self.true_speed(), 0.05)

    def test_walks_on_with_a_dog_whose_banner_was_lost(self) -> None:
        """After a reboot without a banner the driver repeats the current gait."""
        driver = self.ready()
        driver.act({"base.vx": 0.1}, self.permit(seconds=9.0))
        self.pass_time(0.5)
        self.faults.drop = 1.0
        self.robot.reboot()
        self.pass_time(1.6)
        self.faults.drop = 0.0
        self.pass_time(1.0)
        driver.act({"base.vx": 0.1}, self.permit())
        self.pass_time(0.1)
        self.assertGreater(self.true_speed(), 0.05)

    def test_takes_up_a_dog_that_was_silent(self) -> None:
        """A silent dog is stale and stopped; ``problem`` contains the cause until the dog replies again."""
        driver = self.ready()
        driver.act({"base.vx": 0.1}, self.permit(seconds=2.0))
        self.faults.half_open = True
        self.pass_time(9.0)
        self.assertEqual((driver.state, self.true_speed()), ("stale", 0.0))
        self.assertIn("switched on", driver.problem)
        self.faults.half_open = False
        self.pass_time(8.0)
        self.assertEqual((driver.state, driver.problem), ("ready", ""))

    def test_lives_with_a_foul_wire(self) -> None:
        """If a tenth of the lines is lost and a tenth is invalid, split or delayed, the dog still walks and stops.

        The driver counts the errors.
        """
        driver = self.ready()
        self.faults.drop = self.faults.garbage = 0.1
        self.faults.split, self.faults.delay = True, 0.01
        for _ in range(40):
            if driver.state == "ready":
                driver.act({"base.vx": 0.1}, self.permit())
            self.pass_time(0.2)
        self.pass_time(3.0)
        self.assertLess(self.true_speed(), 0.01)
        self.assertGreater(self.body.x, 0.3)
        self.assertGreater(driver.diagnostics()["bad_frames"], 3)

    def test_says_that_the_board_is_another(self) -> None:
        """If the option ``board`` is wrong, ``problem`` contains the board that the robot reports."""
        driver = self.connected(board="nyboard")
        self.assertIn("biboard", driver.problem)

    def test_complains_of_a_gait_that_the_dog_does_not_know(self) -> None:
        """A gait in the options that the firmware lacks is counted as refused, and is not requested again."""
        driver = self.ready(gaits={"moonF": [0.1, 0.0]})
        driver.act({"base.vx": 0.1}, self.permit(seconds=3.0))
        self.pass_time(2.0)
        self.assertEqual(self.robot.received_commands.count(b"kmoonF"), 1)
        self.assertEqual(driver.diagnostics()["refused"], 1)


class ResettingTests(BittleCase):
    """A board that resets when its port is opened."""

    resets = True

    def test_waits_until_it_has_booted(self) -> None:
        """The first request is lost; the driver repeats it and connects."""
        driver = self.make_driver()
        connected = driver.connect()
        self.pass_time(0.5)
        self.assertNoResult(connected)
        self.pass_time(3.5)
        self.successResultOf(connected)


class NyBoardTests(BittleCase):
    """An older board on a serial port."""

    board = "nyboard"

    def test_is_found_by_its_version(self) -> None:
        """The board is recognised by its version, reports roll and pitch, and gets no request for its battery."""
        self.body.values["imu.pitch"] = -0.3
        driver = self.connected(3.0)
        self.assertEqual(self.value(driver, "mode"), "nyboard")
        self.near(self.value(driver, "imu.pitch"), -0.3, 0.01)
        self.assertIsNotNone(self.value(driver, "joint.head_pan.pos"))
        self.assertNotIn(b"P", self.robot.received_commands)


class WifiTests(BittleCase):
    """A BiBoard that is controlled through its web server."""

    def build(self) -> None:
        super().build()
        self.connector = MemoryConnector(self.clock, self.robot.accept_http)
        self.options = {"gaits": GAITS, "host": "10.0.0.5", "board": self.board}

    def walking(self) -> BittleDriver:
        driver: BittleDriver = self.ready(1.5)
        driver.act({"base.vx": 0.1}, self.permit(seconds=1.5))
        self.pass_time(1.0)
        self.assertGreater(self.true_speed(), 0.05)
        return driver

    def test_walks_and_stops(self) -> None:
        """Over Wi-Fi the driver connects and reports observations; the dog stands, walks, and stops at its deadline."""
        driver = self.walking()
        self.pass_time(1.5)
        self.assertLess(self.true_speed(), 0.01)
        self.assertIsNotNone(self.value(driver, "imu.roll"))
        self.assertIsNotNone(self.value(driver, "joint.head_pan.pos"))
        done = driver.invoke("hi")
        self.pass_time(2.0)
        self.assertEqual(self.successResultOf(done), {"skill.done": "hi"})
        driver.disconnect()
        self.pass_time(0.5)
        self.assertTrue(self.robot.is_limp)

    def test_is_let_go_once_it_was_told_to_lie_down(self) -> None:
        """``disconnect`` fires after the last command has reached the dog, or after a timeout."""
        for is_dead in (False, True):
            driver = self.walking()
            self.robot.received_commands.clear()
            self.faults.half_open = is_dead
            self.connector.is_open = not is_dead
            left = driver.disconnect()
            began = self.now()
            while not left.called and self.now() < began + 4.0:
                self.pass_time(self.STEP_S)
            self.successResultOf(left)
            self.assertEqual(self.robot.received_commands[-1:], [] if is_dead else [b"d"])
            self.faults.half_open, self.connector.is_open = False, True
            self.pass_time(3.0)

    def test_outlives_a_lost_network(self) -> None:
        """Without the network the driver is stale with a problem.

        When the network returns, it is ready and the dog stands.
        """
        driver = self.walking()
        self.connector.is_open = False
        self.pass_time(12.0)
        self.assertEqual(driver.state, "stale")
        self.assertIn("does not answer", driver.problem)
        self.connector.is_open = True
        self.pass_time(8.0)
        self.assertEqual(driver.state, "ready")
        self.assertLess(self.true_speed(), 0.01)

    def test_lives_with_a_foul_network(self) -> None:
        """Lost, invalid and split responses cause delays but no exceptions, and the dog still stops."""
        driver = self.walking()
        self.faults.drop = self.faults.garbage = 0.1
        self.faults.split = True
        for _ in range(60):
            with contextlib.suppress(NotEnabled):  # after a lost connection the dog first lies down and then stands up
                driver.act({"base.vx": 0.1}, self.permit())
            self.pass_time(0.2)
        self.faults.drop = self.faults.garbage = 0.0
        self.pass_time(8.0)
        self.assertEqual((driver.state, self.true_speed()), ("ready", 0.0))
        driver.act({"base.vx": 0.1}, self.permit())

    def test_web_server_outlives_rubbish(self) -> None:
        """The web server replies to an invalid request with status 400 or closes the connection.

        The number of tasks that it stores is limited.
        """
        for data in (b"\r\n\r\n", b"RUBBISH\r\n\r\n", b"GET http://[ HTTP/1.1\r\n\r\n"):
            link = KeptLink()
            self.robot.accept_http(link).data_received(data)
            self.assertTrue(link.said.startswith(b"HTTP/1.1 400 "), data)
        link = KeptLink()
        page = self.robot.accept_http(link)
        for _ in range(100):
            page.data_received(bytes(1000))
        self.assertTrue(link.is_closed)
        path = "/cmd?cmd=j" if self.board == "biboard" else "/action?name=j"
        for _ in range(200):
            self.robot.accept_http(KeptLink()).data_received(f"GET {path} HTTP/1.1\r\n\r\n".encode())
            self.pass_time(0.1)
        self.assertLessEqual(len(self.robot.tasks) + len(self.robot.task_output), 50)

    def test_names_the_wrong_board(self) -> None:
        """If the option ``board`` is wrong, ``problem`` contains the HTTP status."""
        other = "nyboard" if self.board == "biboard" else "biboard"
        driver = self.make_driver(board=other)
        connected = driver.connect()
        self.pass_time(6.0)
        self.assertNoResult(connected)
        connected.addErrback(lambda _: None)
        self.assertIn("404", driver.problem)

    def test_may_be_given_up_at_any_moment(self) -> None:
        """A ``disconnect`` at any moment while the driver connects closes the driver immediately."""
        for steps in range(0, 60, 3):
            driver = self.make_driver()
            driver.connect().addErrback(lambda _: None)
            self.pass_time(self.STEP_S * steps)
            driver.disconnect()
            self.assertEqual(driver.state, "closed")


class NyBoardWifiTests(WifiTests):
    """A NyBoard with a Wi-Fi dongle."""

    board = "nyboard"
