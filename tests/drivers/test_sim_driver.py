"""Tests of ``drivers.sim.driver`` against the robot simulator, connected in memory."""

from __future__ import annotations

import json
import math
from random import Random

from twisted.internet.defer import Deferred
from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from drivers.conformance import Conformance
from drivers.driver import Permit
from drivers.errors import LinkLost, NoReply, NotEnabled, Unsupported, UsageError
from drivers.link import Link, MemoryConnector, Receiver
from drivers.sim.client import SimulatorClient
from drivers.sim.codec import Motors, Sensors, encode_message
from drivers.sim.driver import SimDriver
from sim.robots.scene import load_scene
from sim.robots.simulator import RobotSimulator
from tests.drivers.contract import RobotCase


def pump(clock: Clock, seconds: float) -> None:
    """Advance the time in small steps, because a reply may trigger another reply."""
    clock.pump([0.004] * round(seconds / 0.004))


class SimDriverTests(Conformance, RobotCase):
    """The driver of a simulated dog passes the conformance tests and further tests of its functions."""

    STEP_S = 0.004
    kind = "sim"
    options = {"robot": "dog1", "camera": False}

    def build(self) -> None:
        self.yard = self.robot = RobotSimulator(self.clock, Random(1), load_scene("three-dogs"))
        self.yard.start()
        self.connector = self.yard.connector()

    def true_speed(self) -> float:
        motion = self.yard.world.dogs["dog1"].motion
        return math.hypot(motion.vx, motion.vy)

    def test_shows_every_key_with_four_samples(self) -> None:
        """An observation has the keys of an ERS-7, with four samples for each ranger and accelerometer."""
        seen = self.newest(self.connected())
        self.assertEqual(
            set(seen.values),
            {"base.vx", "base.vy", "base.wz", "base.moving", "odom.x", "odom.y", "odom.yaw", "range.near", "range.far"}
            | {"range.chest", "imu.ax", "imu.ay", "imu.az", "power.level", "estop.engaged"}
            | {"compass.heading"},
        )
        self.assertEqual({len(row) for row in seen.samples.values()}, {4})
        self.assertEqual(len(seen.samples), 6)
        self.assertIsNone(seen.frame)
        self.assertIs(seen.values["estop.engaged"], True)
        self.assertLess(abs(float(seen.values["imu.az"]) - 9.8), 0.5)

    def test_gets_pictures_at_the_rate_it_asked_for(self) -> None:
        """At 15 frames per second, two seconds give 30 complete JPEGs with consecutive numbers."""
        driver = self.make_driver(camera=True, camera_fps=15)
        seen: set[int] = set()
        driver.subscribe(lambda one: seen.add(one.frame.seq if one.frame else 0))
        driver.connect()
        self.pass_time(2.0)
        self.assertEqual(driver.diagnostics()["pictures"], 30)
        self.assertEqual(seen - {0}, set(range(1, 31)))
        frame = self.newest(driver).frame
        assert frame is not None
        self.assertTrue(frame.data.startswith(b"\xff\xd8") and frame.data.endswith(b"\xff\xd9"))
        self.assertEqual((frame.width, frame.height), (208, 160))

    def test_is_told_that_there_is_no_such_robot(self) -> None:
        """Connecting to a robot that the simulator lacks fails immediately; the error lists the simulator's robots."""
        driver = self.make_driver(robot="dog9")
        connected = driver.connect()
        self.pass_time(0.1)
        self.assertIn("dog1, dog2, dog3", str(self.failureResultOf(connected, Unsupported).value))
        self.assertEqual(driver.state, "closed")

    def test_waits_for_a_robot_that_is_taken(self) -> None:
        """A second driver of dog1 is refused while the first is connected, and connects after the first has left."""
        first, second = self.make_driver(), self.make_driver()
        first.connect()
        self.pass_time(0.1)
        connected = second.connect()
        self.pass_time(1.0)
        self.assertNoResult(connected)
        self.assertGreater(second.diagnostics()["refused"], 0)
        first.disconnect()
        self.pass_time(0.5)
        self.successResultOf(connected)

    def test_is_stale_when_the_yard_falls_silent(self) -> None:
        """If the simulator sends nothing over an open link, the driver is stale, and ``act`` raises NotEnabled."""
        driver = self.ready()
        assert self.yard._pending is not None
        self.yard._pending.cancel()
        self.yard._pending = None
        self.pass_time(SimDriver.STALE_S + 0.1)
        self.assertEqual(driver.state, "stale")
        self.assertRaises(NotEnabled, driver.act, {"base.vx": 0.1}, self.permit())

    def test_replays_from_a_seed(self) -> None:
        """The same seed and commands give identical observations and frames."""

        def run() -> list[object]:
            self.setUp()
            driver = self.make_driver(camera=True, camera_fps=30)
            seen: list[object] = []
            driver.subscribe(lambda one: seen.append((one.t_robot, repr(one.values), one.frame)))
            driver.connect()
            self.pass_time(0.2)
            driver.enable()
            self.pass_time(0.1)
            driver.act({"base.vx": 0.16, "base.wz": 0.5}, self.permit(seconds=0.4))
            self.pass_time(0.6)
            self.tearDown()
            return seen

        self.assertEqual(run(), run())


class MuteRobot:
    """A remote end that sends sensor values once and never replies."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.heard = b""
        self.tell()

    def tell(self) -> None:
        self.link.send(encode_message(Sensors(1.0, {"estop.engaged": True}, {}, 0)))

    def data_received(self, data: bytes) -> None:
        self.heard += data

    def link_down(self) -> None:
        """Do nothing."""


class SimDriverAloneTests(SynchronousTestCase):
    """The driver against a faulty remote end."""

    def setUp(self) -> None:
        """Connect a driver to a remote end that sends only on request."""
        self.clock = Clock()
        self.robots: list[MuteRobot] = []
        connector = MemoryConnector(self.clock, self.accept)
        self.driver = SimDriver({"robot": "dog1"}, connector, self.clock)
        self.connected = self.driver.connect()
        pump(self.clock, 0.02)

    def accept(self, link: Link) -> Receiver:
        self.robots.append(MuteRobot(link))
        return self.robots[-1]

    def test_says_that_the_robot_does_not_answer(self) -> None:
        """If the motors are never switched on, ``enable`` fails with NoReply after a second."""
        enabled = self.driver.enable()
        pump(self.clock, 0.9)
        self.assertNoResult(enabled)
        pump(self.clock, 0.2)
        self.failureResultOf(enabled, NoReply)
        self.assertIn(encode_message(Motors(True)), self.robots[0].heard)

    def test_answers_every_switch(self) -> None:
        """If the motors are switched while an earlier switch request fails, all requests get the last result."""
        again: list[Deferred[bool]] = []
        self.driver.enable().addErrback(lambda _: again.append(self.driver.enable()))
        last = self.driver.disable()
        pump(self.clock, 1.1)
        for switched in (*again, last):
            self.failureResultOf(switched, NoReply)
        self.assertEqual(len(again), 1)

    def test_lives_on_after_bad_bytes(self) -> None:
        """Invalid bytes are counted and dropped, and so are messages that only clients may send."""
        self.robots[0].link.send(b"rubbish" + encode_message(Motors(True)))
        self.robots[0].tell()
        pump(self.clock, 0.02)
        self.assertEqual(self.driver.diagnostics()["bad_frames"], 2)
        self.assertEqual(self.driver.state, "ready")

    def test_ends_the_motion_on_its_own_side_too(self) -> None:
        """At the deadline the driver itself sends one halt."""
        self.robots[0].link.send(encode_message(Sensors(1.0, {"estop.engaged": False}, {}, 0)))
        pump(self.clock, 0.02)
        self.driver.act({"base.vx": 0.1}, Permit(1, self.clock.seconds() + 0.1))
        before = self.robots[0].heard
        pump(self.clock, 0.2)
        self.assertEqual(self.robots[0].heard[len(before) :].count(b"halt"), 1)


class SimulatorClientTests(SynchronousTestCase):
    """The operator's client of the protocol of the simulator."""

    def setUp(self) -> None:
        """Create a simulator and a connected operator."""
        self.clock = Clock()
        self.yard = RobotSimulator(self.clock, Random(1), load_scene("three-dogs"))
        self.yard.start()
        self.connector = self.yard.connector()
        self.operator = SimulatorClient(self.connector, self.clock)
        self.connected = self.operator.connect()
        pump(self.clock, 0.2)

    def test_sees_the_truth(self) -> None:
        """The snapshot equals the state of the world, in values that JSON can encode."""
        snapshot = self.successResultOf(self.connected)
        self.assertEqual(list(snapshot["walls"]), [3.0, 2.4])
        self.assertEqual([dog["name"] for dog in snapshot["dogs"]], ["dog1", "dog2", "dog3"])
        self.assertIsNone(snapshot["target"])
        json.dumps(self.operator.snapshot)

    def test_moves_things(self) -> None:
        """The operator moves target and dogs, and the next snapshots show it."""
        seen: list[object] = []
        end = self.operator.subscribe(lambda snapshot: seen.append(snapshot["target"]))
        for order in (
            self.operator.place_target(2.0, 1.0),
            self.operator.move_dog("dog1", 1.0, 1.0, 0.5),
        ):
            pump(self.clock, 0.2)
            self.assertIs(self.successResultOf(order), True)
        snapshot = self.operator.snapshot
        assert snapshot is not None
        self.assertEqual(snapshot["target"], {"x": 2.0, "y": 1.0, "radius": 0.08})
        self.assertEqual((snapshot["dogs"][0]["x"], snapshot["dogs"][0]["heading"]), (1.0, 0.5))
        end()
        for order in (self.operator.clear_target(), self.operator.scatter(3), self.operator.place_target_at_random()):
            pump(self.clock, 0.1)
            self.assertIs(self.successResultOf(order), True)
        self.assertIn(snapshot["target"], seen)

    def test_is_told_why_not(self) -> None:
        """A request that the simulator cannot execute fails with the simulator's message."""
        for order, words in (
            (self.operator.place_target(9.0, 1.0), "does not fit"),
            (self.operator.move_dog("dog7", 1.0, 1.0, 0.0), "no dog is named"),
        ):
            pump(self.clock, 0.1)
            self.assertIn(words, str(self.failureResultOf(order, UsageError).value))

    def test_fails_orders_without_a_link(self) -> None:
        """Requests fail with LinkLost when the link breaks, and also until it is open again."""
        on_the_way = self.operator.clear_target()
        self.connector.cut()
        self.failureResultOf(on_the_way, LinkLost)
        self.failureResultOf(self.operator.clear_target(), LinkLost)
        self.assertIsNone(self.operator.snapshot)
        pump(self.clock, 0.4)
        self.assertIsNotNone(self.operator.snapshot)

    def test_leaves_nothing_behind(self) -> None:
        """No timer remains after ``disconnect`` is called once or twice."""
        self.operator.disconnect()
        self.operator.disconnect()
        self.yard.stop()
        pump(self.clock, 0.02)
        self.assertEqual(self.clock.getDelayedCalls(), [])
