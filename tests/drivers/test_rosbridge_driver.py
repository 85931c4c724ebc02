"""Tests of ``drivers.rosbridge.driver`` against its emulator, connected in memory."""

from __future__ import annotations

import math
from random import Random
from typing import Any

from drivers.conformance import Conformance
from drivers.errors import LinkLost, NoReply, RobotError, Unsupported
from drivers.link import Link, MemoryConnector
from drivers.registry import describe
from drivers.rosbridge.driver import MESSAGE_TTL_S, SERVICE_TIMEOUT_S, RosbridgeDriver
from drivers.rosbridge.link import ANSWER_TIMEOUT_S
from sim.robots.emulator.rosbridge import RosbridgeRobot
from tests.drivers.contract import KeptLog, RobotCase

JPEG = b"\xff\xd8\xff\xc0\x00\x0b\x08\x00\x60\x00\x80\x01\x11\x00\x00\xff\xd9"
"""The head of a JPEG of 128 x 96 pixels."""
IMAGE = "/camera/image_raw/compressed"


class RosbridgeDriverTests(Conformance, RobotCase):
    """The ROS driver passes the conformance tests and further tests of its functions."""

    kind = "rosbridge"

    def build(self) -> None:
        """Create a robot without obstacles."""
        self.body.jpeg = JPEG
        self.body.values = {"power.level": 0.8, "range.near": 0.5, "range.left": math.nan, "range.chest": 0.2}
        self.robot = RosbridgeRobot(self.clock, self.body, Random(1))
        self.robot.start()
        self.connector = MemoryConnector(self.clock, self.robot.accept)

    def values(self, driver: RosbridgeDriver) -> dict[str, Any]:
        return dict(self.newest(driver).values)

    def heard(self, op: str) -> list[dict[str, Any]]:
        return [said for said in self.robot.received_messages if said["op"] == op]

    def test_drives_with_the_type_that_the_robot_listens_to(self) -> None:
        """The driver queries which velocity type the robot uses, so neither Twist nor TwistStamped needs an option."""
        for kind in ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped", "geometry_msgs/Twist"):
            self.robot.velocity_type = kind
            driver = self.ready()
            driver.act({"base.vx": 0.2, "base.wz": -0.5}, self.permit())
            self.pass_time(0.1)
            self.assertEqual(self.body.motion, (0.2, 0.0, -0.5), kind)
            self.assertEqual(self.robot.ignored_count, 0)
            driver.disconnect()
            self.pass_time(0.1)

    def test_takes_twist_where_nobody_can_be_asked(self) -> None:
        """Without rosapi the driver waits one second and then uses Twist.

        If an option states the type, the driver does not wait.
        """
        self.robot.has_rosapi = False
        driver = self.make_driver()
        connected = driver.connect()
        self.pass_time(0.9)
        self.assertNoResult(connected)
        self.pass_time(0.3)
        self.successResultOf(connected)
        self.assertTrue(self.heard("advertise")[-1]["type"].endswith("/Twist"))
        told = self.make_driver(velocity_type="twist_stamped")
        connected = told.connect()
        self.pass_time(0.2)
        self.successResultOf(connected)
        self.assertEqual(self.heard("advertise")[-1]["type"], "geometry_msgs/msg/TwistStamped")

    def test_takes_an_answer_that_comes_late(self) -> None:
        """If rosapi replies after the timeout, the type is changed, and the next connection starts with this type."""
        self.robot.velocity_type = "geometry_msgs/msg/TwistStamped"
        self.robot.rosapi_s = 1.5
        driver = self.make_driver()
        driver.connect()
        self.pass_time(2.0)
        driver.enable()
        self.pass_time(0.2)
        driver.act({"base.vx": 0.1}, self.permit())
        self.pass_time(0.1)
        self.assertEqual(self.true_speed(), 0.1)
        self.assertTrue(self.heard("advertise")[-1]["type"].endswith("/TwistStamped"))
        self.assertIn("Twist", {one["type"].rpartition("/")[2] for one in self.heard("advertise")})
        self.robot.has_rosapi = False
        self.cut_link()
        self.robot.received_messages.clear()
        self.pass_time(2.0)
        self.assertTrue(self.heard("advertise")[0]["type"].endswith("/TwistStamped"))

    def test_waits_for_a_base_that_is_still_starting(self) -> None:
        """The robot is not ready until a node subscribes to the velocity; the driver repeats the query."""
        self.robot.velocity_type = ""
        driver = self.make_driver()
        connected = driver.connect()
        self.pass_time(3.0)
        self.assertNoResult(connected)
        self.assertEqual(driver.state, "connecting")
        self.robot.velocity_type = "geometry_msgs/msg/Twist"
        self.pass_time(1.2)
        self.successResultOf(connected)

    def test_warns_of_a_type_that_the_robot_ignores(self) -> None:
        """With a wrong explicit type the robot does not move, and the warning contains the option."""
        warnings: list[str] = []
        driver = self.make_driver(velocity_type="twist_stamped")
        driver._warn_once = warnings.append
        driver.connect()
        self.pass_time(0.3)
        self.assertIn('velocity_type = "twist"', warnings[0])
        self.assertGreater(self.robot.ignored_count, 0)

    def test_says_the_velocity_again_and_zero_at_the_end(self) -> None:
        """The velocity is published ten times per second; at the deadline zero is published once, then nothing more."""
        driver = self.ready()
        self.robot.received_messages.clear()
        driver.act({"base.vx": 0.1}, self.permit(seconds=1.0))
        self.pass_time(1.5)
        said = [one["msg"]["linear"]["x"] for one in self.heard("publish")]
        self.assertEqual(said[-1], 0.0)
        self.assertEqual(set(said[:-1]), {0.1})
        self.assertIn(len(said), (11, 12))
        self.assertLess(abs(self.body.x - 0.1), 0.01)

    def test_stops_at_its_base_when_the_link_is_lost(self) -> None:
        """If the link is lost, the timeout of the base stops it; a new link starts with zero velocity."""
        driver = self.ready()
        driver.act({"base.vx": 0.2}, self.permit(seconds=5.0))
        self.pass_time(0.2)
        self.connector.is_open = False
        self.connector.cut()
        self.pass_time(0.3)
        self.assertGreater(self.true_speed(), 0.1)
        self.pass_time(0.3)
        self.assertEqual(self.true_speed(), 0.0)
        self.robot.received_messages.clear()
        self.connector.is_open = True
        self.pass_time(2.0)
        self.assertEqual([one["msg"]["linear"]["x"] for one in self.heard("publish")], [0.0])

    def test_sees_what_its_topics_say(self) -> None:
        """Pose, velocity, scan sectors, battery, attitude and frames are observed in SI units."""
        driver = self.ready(imu_topic="/imu", image_topic=IMAGE)
        driver.act({"base.vx": 0.1, "base.wz": 0.5}, self.permit(seconds=1.0))
        self.pass_time(0.5)
        seen, values = self.newest(driver), self.values(driver)
        assert seen.frame is not None
        self.assertEqual((values["base.vx"], values["base.wz"], values["base.moving"]), (0.1, 0.5, True))
        self.assertLess(abs(values["odom.yaw"] - self.body.yaw), 0.05)
        self.assertEqual(values["range.front"], 0.5)
        self.assertTrue(math.isnan(values["range.left"]))
        self.assertEqual((values["power.level"], values["power.charging"]), (0.8, False))
        self.assertNotIn("power.amps", values)
        self.assertEqual(values["imu.az"], 9.8)
        self.assertEqual((seen.frame.width, seen.frame.height, seen.frame.data), (128, 96, JPEG))
        self.assertEqual(driver.description.capabilities["camera"]["fps"], 10.0)

    def test_asks_for_as_many_pictures_as_are_wanted(self) -> None:
        """A new frame rate renews the subscription to frames, and the rate zero ends it.

        A robot without an image topic has no camera.
        """
        driver = self.ready(image_topic=IMAGE, camera_fps=5)
        driver.set_camera_fps(0)
        self.pass_time(0.1)
        before = driver.diagnostics()["pictures"]
        self.pass_time(1.0)
        self.assertEqual((driver.diagnostics()["pictures"], driver.camera_fps), (before, 0.0))
        driver.set_camera_fps(5)
        self.pass_time(2.0)
        self.assertIn(driver.diagnostics()["pictures"] - before, range(8, 11))
        blind = self.ready()
        blind.set_camera_fps(5)
        self.assertEqual((blind.camera_fps, "camera" in blind.description.capabilities), (0.0, False))

    def test_leaves_out_what_a_silent_topic_said(self) -> None:
        """The age of a silent scan grows; after two seconds its distances are omitted."""
        driver = self.ready()
        for client in self.robot._clients:
            client._topics.pop("/scan")
        self.pass_time(MESSAGE_TTL_S - 0.5)
        self.assertIn("range.front", self.values(driver))
        self.assertGreater(driver.diagnostics()["age.scan"], 1.0)
        self.pass_time(1.0)
        self.assertNotIn("range.front", self.values(driver))
        self.assertEqual((driver.state, self.values(driver)["power.level"]), ("ready", 0.8))

    def test_switches_motors_that_there_are(self) -> None:
        """``enable`` and ``disable`` call the motor service, and fail with NoReply if this service is missing."""
        self.robot.has_motor_power = False
        driver = self.ready(motor_service="/motor_power")
        self.assertTrue(self.robot.has_motor_power)
        driver.disable()
        self.pass_time(0.2)
        self.assertFalse(self.robot.has_motor_power)
        other = self.make_driver(motor_service="/nothing")
        other.connect()
        self.pass_time(0.4)
        enabled = other.enable()
        self.pass_time(1.2)
        self.failureResultOf(enabled, NoReply)
        self.assertIs(self.values(other)["estop.engaged"], True)

    def test_has_the_skills_that_are_set(self) -> None:
        """A skill calls its service; unknown, failing, lost and late calls fail with the matching error."""
        driver = self.ready(services={"dock": "/dock", "sing": "/sing"})
        self.assertEqual(driver.description.skills, ("dock", "sing"))
        docked, sung = driver.invoke("dock"), driver.invoke("sing")
        self.pass_time(0.1)
        self.assertEqual(self.successResultOf(docked), {"success": True, "message": "docked"})
        self.assertIn("does not exist", str(self.failureResultOf(sung, RobotError).value))
        self.failureResultOf(driver.invoke("fly"), Unsupported)
        lost = driver.invoke("dock")
        self.cut_link()
        self.failureResultOf(lost, LinkLost)
        self.failureResultOf(driver.invoke("dock"), LinkLost)
        self.pass_time(1.0)
        self.robot.faults.half_open = True
        late = driver.invoke("dock")
        self.pass_time(ANSWER_TIMEOUT_S + SERVICE_TIMEOUT_S + 1.0)
        self.failureResultOf(late, LinkLost)

    def test_counts_what_rosbridge_complains_about(self) -> None:
        """An error that rosbridge reports is counted and logged once; unknown topics and late replies are ignored."""
        driver = self.ready()
        driver.log = log = KeptLog()
        for _ in range(2):
            driver.bridge_received(b'{"op":"status","level":"error","msg":"no such type"}')
            driver.bridge_received(b'{"op":"status","level":"info","msg":"hello"}')
            driver.bridge_received(b'{"op":"publish","topic":"/rosout","msg":{}}')
            driver.bridge_received(b'{"op":"service_response","id":"call:99","values":{}}')
        self.assertEqual((driver.diagnostics()["refused"], driver.diagnostics()["bad_frames"]), (2, 0))
        self.assertEqual(log.lines, ["robot: rosbridge says: no such type"])

    def test_calls_what_speaks_no_rosbridge_ever_more_slowly(self) -> None:
        """The driver retries a server that is not rosbridge, with delays of up to 5 s; ``connect`` still waits."""
        calls: list[float] = []

        class Web:
            def __init__(self, link: Link) -> None:
                self.link = link

            def data_received(self, data: bytes) -> None:
                calls.append(self_.clock.seconds())
                self.link.send(b"HTTP/1.1 404 Not Found\r\n\r\n")
                if is_curt:
                    self.link.close()

            def link_down(self) -> None:
                pass

        self_ = self
        for is_curt in (False, True):
            calls.clear()
            driver = RosbridgeDriver({}, MemoryConnector(self.clock, Web), self.clock)
            connected = driver.connect()
            self.pass_time(30.0)
            self.assertNoResult(connected)
            self.assertIn(len(calls), range(6, 11), is_curt)
            self.assertGreater(calls[-1] - calls[-2], 4.9)
            driver.disconnect()
            self.failureResultOf(connected, LinkLost)

    def test_lives_with_a_foul_wire(self) -> None:
        """Invalid, lost, delayed and split data destroy frames and links; after these faults the driver is ready."""
        driver = self.ready(image_topic=IMAGE)
        self.robot.faults.garbage, self.robot.faults.drop = 0.1, 0.05
        self.robot.faults.split, self.robot.faults.delay = True, 0.02
        self.pass_time(20.0)
        counts = driver.diagnostics()
        self.assertGreater(counts["bad_frames"] + counts["faults"], 0)
        self.robot.faults.garbage = self.robot.faults.drop = 0.0
        self.pass_time(12.0)
        self.assertEqual(driver.state, "ready")
        driver.act({"base.vx": 0.1}, self.permit())
        self.robot.faults.delay = 0.0

    def test_notices_a_link_that_is_half_open(self) -> None:
        """A silent robot on an open link is stale at the next check, and is reconnected after three seconds."""
        driver = self.ready()
        self.robot.faults.half_open = True
        self.pass_time(0.7)
        self.assertEqual(driver.state, "stale")
        self.pass_time(ANSWER_TIMEOUT_S + 2.0)
        self.assertGreater(driver.diagnostics()["faults"], 0)
        self.robot.faults.half_open = False
        self.pass_time(9.0)
        self.assertEqual(driver.state, "ready")

    def test_is_described_by_its_options(self) -> None:
        """The description lists the topics' sensors, and a sideways limit if the options permit sideways motion."""
        holonomic = describe("rosbridge", {"max_vy": 0.3, "model": "Omni", "imu_topic": "/imu"})
        self.assertEqual(holonomic.limits["base.vy"], (-0.3, 0.3))
        self.assertIn("imu", holonomic.capabilities)
