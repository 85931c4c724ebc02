"""Tests of the dead man's switch: its halt condition, its protocol, and its use by the drivers."""

from __future__ import annotations

import json
from random import Random
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from drivers.aibo.driver import AiboDriver
from drivers.base import BaseDriver
from drivers.bittle.driver import BittleDriver
from drivers.bittle.link import HttpConnector
from drivers.bittle.option import parse_options as checked_bittle
from drivers.create2.driver import Create2Driver
from drivers.create2.option import parse_options as checked_create2
from drivers.deadman.process import (
    ARM,
    DISARM,
    GRACE_S,
    HALT_REPEAT_S,
    HEADER,
    LINK_LOST,
    SET_LINK,
    SET_SERVER,
    CommandServer,
    HaltTimer,
    MessageParser,
    SharedLink,
)
from drivers.deadman.switch import HaltCommand, MemoryDeadManSwitch
from drivers.driver import Permit
from drivers.errors import StaleCommand
from drivers.link import MemoryConnector, MemoryLink
from drivers.reading import Action, Description
from drivers.registry import create_driver
from drivers.rosbridge.driver import TYPE_TIMEOUT_S, RosbridgeDriver
from sim.robots.emulator.aibo_dog import AiboEmulator
from sim.robots.emulator.bittle import Bittle
from sim.robots.emulator.create2 import Create2
from sim.robots.emulator.rosbridge import RosbridgeRobot
from tests.drivers.contract import RobotCase
from tests.formats.rfc6455 import masked


class RecordingLink(SharedLink):
    """A channel that records halt messages; each message is confirmed if ``is_answered`` is set."""

    def __init__(self, is_answered: bool = False) -> None:
        super().__init__(-1)
        self.said: list[bytes] = []
        self.is_open = True
        self._is_answered = is_answered

    def send(self, halt: bytes) -> bool:
        self.said.append(halt)
        return self._is_answered

    def close(self) -> None:
        self.is_open = False


class HaltTimerTests(SynchronousTestCase):
    """The times and the number of halts."""

    def setUp(self) -> None:
        """Guard a robot that is permitted to move until 10 s."""
        self.link = RecordingLink()
        self.timer = HaltTimer()
        self.timer.set_halt_command(self.link, b"halt")
        self.timer.arm(10.0)

    def test_halts_when_the_time_is_over(self) -> None:
        """The halt is sent three times after the deadline plus a grace period, and counted once."""
        wait = self.timer.get_timeout(9.0)
        self.assertIsNotNone(wait)
        self.assertAlmostEqual(wait or 0.0, 1.0 + GRACE_S)
        self.timer.send_due_halts(10.0)
        self.assertEqual(self.link.said, [])
        self.timer.send_due_halts(10.1)
        self.assertEqual(self.link.said, [b"halt"])
        self.assertAlmostEqual(self.timer.get_timeout(10.1) or 0.0, HALT_REPEAT_S)
        for moment in (10.15, 10.21, 10.32, 10.5, 20.0):
            self.timer.send_due_halts(moment)
        self.assertEqual(self.link.said, [b"halt"] * 3)
        self.assertEqual(self.timer.halts, 1)
        self.assertIsNone(self.timer.get_timeout(20.0))

    def test_heeds_newer_words(self) -> None:
        """A new deadline replaces the old deadline; ``disarm`` removes the deadline.

        Both end the repetition of a halt.
        """
        self.timer.arm(11.0)
        self.timer.send_due_halts(10.5)
        self.assertEqual(self.link.said, [])
        self.timer.disarm()
        self.timer.send_due_halts(12.0)
        self.assertIsNone(self.timer.get_timeout(12.0))
        self.assertEqual(self.link.said, [])
        for newer in (self.timer.disarm, lambda: self.timer.arm(30.0)):
            self.timer.arm(13.0)
            self.timer.send_due_halts(14.0)
            newer()
            self.link.said.clear()
            self.timer.send_due_halts(14.5)
            self.assertEqual(self.link.said, [])

    def test_halts_at_once_when_the_node_is_gone(self) -> None:
        """When the node ends, a robot that may move is halted immediately; to a robot at rest nothing is sent."""
        self.timer.on_node_end(5.0)
        self.timer.send_due_halts(5.001)
        self.assertEqual(self.link.said, [b"halt"])
        still = HaltTimer()
        still.set_halt_command(RecordingLink(), b"halt")
        still.on_node_end(5.0)
        self.assertIsNone(still.get_timeout(5.0))

    def test_lets_go_of_what_was_guarded(self) -> None:
        """A new channel to the robot replaces and closes the old channel; the deadline is kept.

        Without a channel no halt is sent or counted.
        """
        other = RecordingLink()
        self.timer.set_halt_command(other, b"other")
        self.assertFalse(self.link.is_open)
        self.timer.send_due_halts(10.1)
        self.assertEqual((self.link.said, other.said), ([], [b"other"]))
        self.timer.arm(11.0)
        self.timer.on_link_lost()
        self.assertFalse(other.is_open)
        self.timer.arm(12.0)
        self.timer.send_due_halts(13.0)
        self.assertEqual((self.timer.halts, self.timer.get_timeout(13.0)), (1, None))

    def test_asks_a_server_until_it_answers(self) -> None:
        """A halt that a server confirmed is not repeated."""
        server = RecordingLink(is_answered=True)
        self.timer.set_halt_command(server, b"GET")
        for moment in (10.1, 10.3, 10.5):
            self.timer.send_due_halts(moment)
        self.assertEqual(server.said, [b"GET"])


class RecordingTimer(HaltTimer):
    """A timer that records its calls."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[Any] = []

    def set_halt_command(self, link: SharedLink | CommandServer, halt: bytes) -> None:
        where = link._descriptor if isinstance(link, SharedLink) else link._address
        self.calls.append((type(link), where, halt))

    def arm(self, moment: float) -> None:
        self.calls.append(moment)

    def disarm(self) -> None:
        self.calls.append("rest")

    def on_link_lost(self) -> None:
        self.calls.append("leave")


class MessageParserTests(SynchronousTestCase):
    """The messages to the process of the switch."""

    def test_hears_words_cut_anyhow(self) -> None:
        """Messages are read however they are split into chunks, and each gets the file descriptor sent with it."""
        said = HEADER.pack(SET_LINK, 0.0, 4) + b"halt" + HEADER.pack(ARM, 7.5, 0) + HEADER.pack(DISARM, 0.0, 0)
        said += HEADER.pack(LINK_LOST, 0.0, 0) + HEADER.pack(SET_LINK, 0.0, 0)
        call = b"10.0.0.5\x0080\0GET /x\0y"
        said += HEADER.pack(SET_SERVER, 0.0, len(call)) + call
        wanted = [
            (SharedLink, 5, b"halt"),
            7.5,
            "rest",
            "leave",
            (SharedLink, 6, b""),
            (CommandServer, ("10.0.0.5", 80), b"GET /x\0y"),
        ]
        whole, slow = RecordingTimer(), RecordingTimer()
        MessageParser(whole).feed(said, [5, 6])
        parser = MessageParser(slow)
        for place in range(len(said)):
            parser.feed(said[place : place + 1], {0: [5], 30: [6]}.get(place, []))
        self.assertEqual(whole.calls, wanted)
        self.assertEqual(slow.calls, wanted)


class OrderedDeadMan(MemoryDeadManSwitch):
    """A dead man's switch that ends when the test fires ``ended``."""

    def close(self) -> Deferred[None]:
        super().close()
        self.ended: Deferred[None] = Deferred()
        return self.ended


class Puppet(BaseDriver):
    """A fake driver that records its commands in the list of calls of its switch."""

    def __init__(self, clock: Clock, switch: OrderedDeadMan | None) -> None:
        description = Description("puppet", "puppet", {"base2d": {}}, {"base.vx": (-1.0, 1.0)}, 0.1)
        super().__init__(description, "puppet", clock, switch)
        self.calls = [] if switch is None else switch.calls
        self.link = MemoryLink(clock, 0.0)

    def up(self) -> None:
        """Open the link and send an observation."""
        self._up()
        self._observed({}, 0.0)

    def down(self) -> None:
        self._down()

    def _open(self) -> None:
        pass

    def _close(self) -> Deferred[None]:
        closed: Deferred[None] = Deferred()
        closed.callback(None)
        return closed

    def _drive(self, motion: Action, permit: Permit) -> Action:
        self.calls.append("drive")
        return motion

    def _halt(self) -> None:
        self.calls.append("halt")

    def _make_halt_command(self) -> HaltCommand:
        return HaltCommand(b"halt", self.link)


class BaseDriverTests(SynchronousTestCase):
    """The calls of each driver to its switch, and their order."""

    def setUp(self) -> None:
        self.clock = Clock()
        self.switch = OrderedDeadMan()
        self.driver = Puppet(self.clock, self.switch)
        self.driver.connect()
        self.driver.up()

    def test_tells_before_it_commands(self) -> None:
        """The switch gets the deadline before the robot gets the motion.

        At the deadline the switch is disarmed first, and then the robot gets the halt.
        """
        self.driver.act({"base.vx": 0.1}, Permit(1, 0.2))
        self.assertEqual(self.switch.seconds, 0.2)
        self.clock.advance(0.2)
        self.assertIsNone(self.switch.seconds)
        self.assertEqual(self.switch.calls, ["guard", "until", "drive", "rest", "halt"])

    def test_a_refused_command_arms_nothing(self) -> None:
        """A command with a lower token or a past deadline does not set the switch."""
        self.driver.act({"base.vx": 0.1}, Permit(5, 0.2))
        for permit in (Permit(4, 5.0), Permit(6, 0.0)):
            self.assertRaises(StaleCommand, self.driver.act, {"base.vx": 0.1}, permit)
        self.assertEqual((self.switch.seconds, self.switch.calls.count("until")), (0.2, 1))

    def test_what_is_over_is_over(self) -> None:
        """If the deadline of a motion has passed but its timer has not run yet, the next command starts from rest."""
        self.driver.act({"base.vx": 0.1}, Permit(1, 0.2))
        self.clock.rightNow = 0.22  # time passes, but no timer runs
        self.assertEqual(self.driver.act({}, Permit(1, 0.5)), {"base.vx": 0.0})
        self.assertEqual(self.switch.calls[3:], ["rest", "halt", "until", "drive"])

    def test_follows_the_link(self) -> None:
        """The switch releases a lost link and guards the next link."""
        self.driver.down()
        self.assertIsNone(self.switch.command)
        self.driver.up()
        self.assertEqual(self.switch.command, HaltCommand(b"halt", self.driver.link))
        self.assertEqual(self.switch.calls, ["guard", "rest", "leave", "guard"])

    def test_ends_with_the_driver(self) -> None:
        """``disconnect`` waits for the end of the switch."""
        ended = self.driver.disconnect()
        self.assertTrue(self.switch.is_closed)
        self.assertNoResult(ended)
        self.switch.ended.callback(None)
        self.assertIsNone(self.successResultOf(ended))

    def test_counts_its_halts(self) -> None:
        """The diagnostics contain ``halts`` only if there is a switch."""
        self.switch.halts = 2
        self.assertEqual(self.driver.diagnostics()["halts"], 2)
        self.assertNotIn("halts", Puppet(self.clock, None).diagnostics())


class HaltCommandTests(RobotCase):
    """The bytes that halt each kind of robot."""

    def build(self) -> None:
        self.switch = MemoryDeadManSwitch()

    def tearDown(self) -> None:
        """Skip the check of the base class, because the robots are still running."""

    def word(self, driver: BaseDriver, settle: float = 1.0) -> HaltCommand:
        """Return the halt message of a driver after it has connected."""
        connected = driver.connect()
        self.pass_time(settle)
        self.successResultOf(connected)
        assert self.switch.command is not None
        return self.switch.command

    def test_aibo(self) -> None:
        """The AIBO gets zero for forward, strafe and rotate; only its walk server gets them."""
        dog = AiboEmulator(self.clock, self.body, Random(1))
        dog.start()
        driver = AiboDriver({"host": "dog", "camera": False}, "dog", dog.connector(), self.clock, dead_man=self.switch)
        command = self.word(driver)
        self.assertEqual(command.data, b"f\0\0\0\0s\0\0\0\0r\0\0\0\0")
        dog.received_commands.clear()
        command.link.send(command.data)
        self.pass_time(0.01)
        self.assertEqual(dog.received_commands, [("f", 0.0), ("s", 0.0), ("r", 0.0)])

    def test_create2(self) -> None:
        """The Create 2 gets Drive Direct with both wheels at 0 (OI specification, opcode 145)."""
        robot = Create2(self.body, self.clock, Random(1))
        connector = MemoryConnector(self.clock, robot.accept)
        driver = Create2Driver(checked_create2({"port": "x"}), "robot", connector, self.clock, self.switch)
        self.assertEqual(self.word(driver).data, bytes((145, 0, 0, 0, 0)))

    def test_bittle(self) -> None:
        """The Bittle gets the skill to stand up with its line feed, or over Wi-Fi the HTTP request for this skill."""
        robot = Bittle(self.body, self.clock, Random(1))
        connector = MemoryConnector(self.clock, robot.accept)
        driver = BittleDriver(checked_bittle({"port": "x"}), "dog", connector, self.clock, self.switch)
        command = self.word(driver)
        self.assertEqual((command.data, command.address), (b"kup\n", None))
        for board, path in (("biboard", b"/cmd?cmd=kup"), ("nyboard", b"/action?name=kup")):
            robot = Bittle(self.body, self.clock, Random(1), board=board)
            options = checked_bittle({"host": "10.0.0.5", "board": board})
            http = HttpConnector(MemoryConnector(self.clock, robot.accept_http), self.clock, board)
            command = self.word(BittleDriver(options, "dog", http, self.clock, self.switch), 1.5)
            self.assertEqual(command.address, ("10.0.0.5", 80))
            self.assertTrue(command.data.startswith(b"GET " + path + b" HTTP/1.1\r\n"))
            self.assertTrue(command.data.endswith(b"\r\n\r\n"))

    def test_rosbridge(self) -> None:
        """A ROS base gets a masked text frame that contains a zero velocity of the type that the base subscribes to."""
        for kind, is_stamped in (("Twist", False), ("TwistStamped", True)):
            robot = RosbridgeRobot(self.clock, self.body, Random(1), velocity_type=f"geometry_msgs/msg/{kind}")
            self.assertEqual("twist" in self.published(self.word(self.rosbridge(robot))), is_stamped)

    def test_rosbridge_that_says_its_type_late(self) -> None:
        """If the message type becomes known later, the halt message is replaced."""
        robot = RosbridgeRobot(self.clock, self.body, Random(1), velocity_type="geometry_msgs/msg/TwistStamped")
        robot.rosapi_s = TYPE_TIMEOUT_S + 1.0
        driver = self.rosbridge(robot)
        self.assertNotIn("twist", self.published(self.word(driver, TYPE_TIMEOUT_S + 0.5)))
        self.pass_time(1.0)
        assert self.switch.command is not None
        self.assertIn("twist", self.published(self.switch.command))

    def rosbridge(self, robot: RosbridgeRobot) -> RosbridgeDriver:
        robot.start()
        connector = MemoryConnector(self.clock, robot.accept)
        return RosbridgeDriver({}, connector, self.clock, "robot", self.switch)

    def published(self, command: HaltCommand) -> dict[str, Any]:
        head, size = command.data[0], command.data[1]
        self.assertEqual(head, 0x81)
        at = 2 if size < 0x80 + 126 else 4
        self.assertGreaterEqual(size, 0x80)
        said = json.loads(masked(command.data[at + 4 :], command.data[at : at + 4]))
        self.assertEqual((said["op"], said["topic"]), ("publish", "/cmd_vel"))
        message: dict[str, Any] = said["msg"]
        velocity = message.get("twist", message)
        self.assertEqual({**velocity["linear"], "turn": velocity["angular"]["z"]}, {"x": 0, "y": 0, "z": 0, "turn": 0})
        return message

    def test_none_in_memory(self) -> None:
        """A driver with links in memory has no switch process."""
        robot = Create2(self.body, self.clock, Random(1))
        connector = MemoryConnector(self.clock, robot.accept)
        driver = create_driver("create2", {"port": "x"}, "robot", self.clock, connector)
        self.assertNotIn("halts", driver.diagnostics())
