"""Tests of the dead man's switch: when it halts a robot, what it hears, and what drivers tell it."""

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
from drivers.bittle.option import checked as checked_bittle
from drivers.create2.driver import Create2Driver
from drivers.create2.option import checked as checked_create2
from drivers.deadman.process import (
    AGAIN_S,
    CALL,
    GRACE_S,
    GUARD,
    HEAD,
    LEAVE,
    REST,
    UNTIL,
    Ear,
    Open,
    Server,
    Watch,
)
from drivers.deadman.switch import LastWord, MemoryDeadMan
from drivers.driver import Permit
from drivers.errors import StaleCommand
from drivers.link import MemoryConnector, MemoryLink
from drivers.reading import Action, Description
from drivers.registry import driver_for
from drivers.rosbridge.driver import ASK_S, RosbridgeDriver
from sim.robots.emulator.aibo_dog import AiboEmulator
from sim.robots.emulator.bittle import Bittle
from sim.robots.emulator.create2 import Create2
from sim.robots.emulator.rosbridge import RosbridgeRobot
from tests.drivers.contract import RobotCase
from tests.formats.rfc6455 import masked


class Way(Open):
    """A way that leads nowhere and keeps what was said; ``is_answered`` as a server that answers."""

    def __init__(self, is_answered: bool = False) -> None:
        super().__init__(-1)
        self.said: list[bytes] = []
        self.is_open = True
        self._is_answered = is_answered

    def say(self, halt: bytes) -> bool:
        self.said.append(halt)
        return self._is_answered

    def close(self) -> None:
        self.is_open = False


class WatchTests(SynchronousTestCase):
    """When a robot is halted."""

    def setUp(self) -> None:
        """A robot that is guarded, and may move until 10."""
        self.way = Way()
        self.watch = Watch()
        self.watch.guard(self.way, b"halt")
        self.watch.until(10.0)

    def test_halts_when_the_time_is_over(self) -> None:
        """Not before the grace after the end; then three times, a tenth of a second apart; that is one halt."""
        wait = self.watch.wait(9.0)
        self.assertIsNotNone(wait)
        self.assertAlmostEqual(wait or 0.0, 1.0 + GRACE_S)
        self.watch.turn(10.0)
        self.assertEqual(self.way.said, [])
        self.watch.turn(10.1)
        self.assertEqual(self.way.said, [b"halt"])
        self.assertAlmostEqual(self.watch.wait(10.1) or 0.0, AGAIN_S)
        for moment in (10.15, 10.21, 10.32, 10.5, 20.0):
            self.watch.turn(moment)
        self.assertEqual(self.way.said, [b"halt"] * 3)
        self.assertEqual(self.watch.halts, 1)
        self.assertIsNone(self.watch.wait(20.0))

    def test_heeds_newer_words(self) -> None:
        """A later end moves it, rest ends it, and either ends what is being said again."""
        self.watch.until(11.0)
        self.watch.turn(10.5)
        self.assertEqual(self.way.said, [])
        self.watch.rest()
        self.watch.turn(12.0)
        self.assertIsNone(self.watch.wait(12.0))
        self.assertEqual(self.way.said, [])
        for newer in (self.watch.rest, lambda: self.watch.until(30.0)):
            self.watch.until(13.0)
            self.watch.turn(14.0)
            newer()
            self.way.said.clear()
            self.watch.turn(14.5)
            self.assertEqual(self.way.said, [])

    def test_halts_at_once_when_the_node_is_gone(self) -> None:
        """If a motion is in force, and else not at all."""
        self.watch.end(5.0)
        self.watch.turn(5.001)
        self.assertEqual(self.way.said, [b"halt"])
        still = Watch()
        still.guard(Way(), b"halt")
        still.end(5.0)
        self.assertIsNone(still.wait(5.0))

    def test_lets_go_of_what_was_guarded(self) -> None:
        """A new way closes the old one, and what is in force stays so; without a way nothing is said or counted."""
        other = Way()
        self.watch.guard(other, b"other")
        self.assertFalse(self.way.is_open)
        self.watch.turn(10.1)
        self.assertEqual((self.way.said, other.said), ([], [b"other"]))
        self.watch.until(11.0)
        self.watch.leave()
        self.assertFalse(other.is_open)
        self.watch.until(12.0)
        self.watch.turn(13.0)
        self.assertEqual((self.watch.halts, self.watch.wait(13.0)), (1, None))

    def test_asks_a_server_until_it_answers(self) -> None:
        """What was answered is not asked for again."""
        server = Way(is_answered=True)
        self.watch.guard(server, b"GET")
        for moment in (10.1, 10.3, 10.5):
            self.watch.turn(moment)
        self.assertEqual(server.said, [b"GET"])


class Told(Watch):
    """A watch that keeps what it was told."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[Any] = []

    def guard(self, way: Open | Server, halt: bytes) -> None:
        where = way._descriptor if isinstance(way, Open) else way._address
        self.told.append((type(way), where, halt))

    def until(self, moment: float) -> None:
        self.told.append(moment)

    def rest(self) -> None:
        self.told.append("rest")

    def leave(self) -> None:
        self.told.append("leave")


class EarTests(SynchronousTestCase):
    """What the process understands."""

    def test_hears_words_cut_anyhow(self) -> None:
        """Whole, or a byte at a time, each word is heard once, and each descriptor goes with its own word."""
        said = HEAD.pack(GUARD, 0.0, 4) + b"halt" + HEAD.pack(UNTIL, 7.5, 0) + HEAD.pack(REST, 0.0, 0)
        said += HEAD.pack(LEAVE, 0.0, 0) + HEAD.pack(GUARD, 0.0, 0)
        call = b"10.0.0.5\x0080\0GET /x\0y"
        said += HEAD.pack(CALL, 0.0, len(call)) + call
        wanted = [
            (Open, 5, b"halt"),
            7.5,
            "rest",
            "leave",
            (Open, 6, b""),
            (Server, ("10.0.0.5", 80), b"GET /x\0y"),
        ]
        whole, slow = Told(), Told()
        Ear(whole).heard(said, [5, 6])
        ear = Ear(slow)
        for place in range(len(said)):
            ear.heard(said[place : place + 1], {0: [5], 30: [6]}.get(place, []))
        self.assertEqual(whole.told, wanted)
        self.assertEqual(slow.told, wanted)


class OrderedDeadMan(MemoryDeadMan):
    """A switch whose end takes until ``ended`` fires."""

    def close(self) -> Deferred[None]:
        super().close()
        self.ended: Deferred[None] = Deferred()
        return self.ended


class Puppet(BaseDriver):
    """A robot of nothing; what it is told goes to the list of its switch, too."""

    def __init__(self, clock: Clock, switch: OrderedDeadMan | None) -> None:
        description = Description("puppet", "puppet", {"base2d": {}}, {"base.vx": (-1.0, 1.0)}, 0.1)
        super().__init__(description, "puppet", clock, switch)
        self.told = [] if switch is None else switch.told
        self.link = MemoryLink(clock, 0.0)

    def up(self) -> None:
        """There is a link, and the robot is seen."""
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
        self.told.append("drive")
        return motion

    def _halt(self) -> None:
        self.told.append("halt")

    def _last_word(self) -> LastWord:
        return LastWord(b"halt", self.link)


class BaseDriverTests(SynchronousTestCase):
    """What every driver tells its switch, and in which order."""

    def setUp(self) -> None:
        self.clock = Clock()
        self.switch = OrderedDeadMan()
        self.driver = Puppet(self.clock, self.switch)
        self.driver.connect()
        self.driver.up()

    def test_tells_before_it_commands(self) -> None:
        """How long a motion is in force is told before it is commanded; at the end the halt goes with the rest."""
        self.driver.act({"base.vx": 0.1}, Permit(1, 0.2))
        self.assertEqual(self.switch.seconds, 0.2)
        self.clock.advance(0.2)
        self.assertIsNone(self.switch.seconds)
        self.assertEqual(self.switch.told, ["guard", "until", "drive", "rest", "halt"])

    def test_a_refused_command_arms_nothing(self) -> None:
        """A command with an old token or a passed deadline is not told."""
        self.driver.act({"base.vx": 0.1}, Permit(5, 0.2))
        for permit in (Permit(4, 5.0), Permit(6, 0.0)):
            self.assertRaises(StaleCommand, self.driver.act, {"base.vx": 0.1}, permit)
        self.assertEqual((self.switch.seconds, self.switch.told.count("until")), (0.2, 1))

    def test_what_is_over_is_over(self) -> None:
        """A command that comes late, before the timer that ends the one before it, begins from rest."""
        self.driver.act({"base.vx": 0.1}, Permit(1, 0.2))
        self.clock.rightNow = 0.22  # time passes, and no timer is called yet
        self.assertEqual(self.driver.act({}, Permit(1, 0.5)), {"base.vx": 0.0})
        self.assertEqual(self.switch.told[3:], ["rest", "halt", "until", "drive"])

    def test_follows_the_link(self) -> None:
        """A lost link is let go, and the next one is guarded."""
        self.driver.down()
        self.assertIsNone(self.switch.word)
        self.driver.up()
        self.assertEqual(self.switch.word, LastWord(b"halt", self.driver.link))
        self.assertEqual(self.switch.told, ["guard", "rest", "leave", "guard"])

    def test_ends_with_the_driver(self) -> None:
        """Whoever disconnects waits for the end of the switch as well."""
        ended = self.driver.disconnect()
        self.assertTrue(self.switch.is_closed)
        self.assertNoResult(ended)
        self.switch.ended.callback(None)
        self.assertIsNone(self.successResultOf(ended))

    def test_counts_its_halts(self) -> None:
        """``halts`` is told where there is a switch, and left out where there is none."""
        self.switch.halts = 2
        self.assertEqual(self.driver.diagnostics()["halts"], 2)
        self.assertNotIn("halts", Puppet(self.clock, None).diagnostics())


class LastWordTests(RobotCase):
    """The bytes by which each robot is halted."""

    def build(self) -> None:
        self.switch = MemoryDeadMan()

    def tearDown(self) -> None:
        """The robots go on."""

    def word(self, driver: BaseDriver, settle: float = 1.0) -> LastWord:
        """What it is guarded by, once it is connected."""
        connected = driver.connect()
        self.pass_time(settle)
        self.successResultOf(connected)
        assert self.switch.word is not None
        return self.switch.word

    def test_aibo(self) -> None:
        """Forward, strafe and rotate of nothing, to the walk server alone."""
        dog = AiboEmulator(self.clock, self.body, Random(1))
        dog.start()
        driver = AiboDriver({"host": "dog", "camera": False}, "dog", dog.connector(), self.clock, dead_man=self.switch)
        word = self.word(driver)
        self.assertEqual(word.halt, b"f\0\0\0\0s\0\0\0\0r\0\0\0\0")
        dog.heard.clear()
        word.link.send(word.halt)
        self.pass_time(0.01)
        self.assertEqual(dog.heard, [("f", 0.0), ("s", 0.0), ("r", 0.0)])

    def test_create2(self) -> None:
        """Drive direct, both wheels at 0 (OI specification, opcode 145)."""
        robot = Create2(self.body, self.clock, Random(1))
        connector = MemoryConnector(self.clock, robot.accept)
        driver = Create2Driver(checked_create2({"port": "x"}), "robot", connector, self.clock, self.switch)
        self.assertEqual(self.word(driver).halt, bytes((145, 0, 0, 0, 0)))

    def test_bittle(self) -> None:
        """Stand up, with the line feed that ends a skill; over HTTP the request for that."""
        robot = Bittle(self.body, self.clock, Random(1))
        connector = MemoryConnector(self.clock, robot.accept)
        driver = BittleDriver(checked_bittle({"port": "x"}), "dog", connector, self.clock, self.switch)
        word = self.word(driver)
        self.assertEqual((word.halt, word.address), (b"kup\n", None))
        for board, path in (("biboard", b"/cmd?cmd=kup"), ("nyboard", b"/action?name=kup")):
            robot = Bittle(self.body, self.clock, Random(1), board=board)
            options = checked_bittle({"host": "10.0.0.5", "board": board})
            http = HttpConnector(MemoryConnector(self.clock, robot.accept_http), self.clock, board)
            word = self.word(BittleDriver(options, "dog", http, self.clock, self.switch), 1.5)
            self.assertEqual(word.address, ("10.0.0.5", 80))
            self.assertTrue(word.halt.startswith(b"GET " + path + b" HTTP/1.1\r\n"))
            self.assertTrue(word.halt.endswith(b"\r\n\r\n"))

    def test_rosbridge(self) -> None:
        """A masked text frame that publishes no velocity, of the type that the base listens to."""
        for kind, is_stamped in (("Twist", False), ("TwistStamped", True)):
            robot = RosbridgeRobot(self.clock, self.body, Random(1), velocity_type=f"geometry_msgs/msg/{kind}")
            self.assertEqual("twist" in self.published(self.word(self.rosbridge(robot))), is_stamped)

    def test_rosbridge_that_says_its_type_late(self) -> None:
        """Where the type is known only later, the switch is told anew."""
        robot = RosbridgeRobot(self.clock, self.body, Random(1), velocity_type="geometry_msgs/msg/TwistStamped")
        robot.rosapi_s = ASK_S + 1.0
        driver = self.rosbridge(robot)
        self.assertNotIn("twist", self.published(self.word(driver, ASK_S + 0.5)))
        self.pass_time(1.0)
        assert self.switch.word is not None
        self.assertIn("twist", self.published(self.switch.word))

    def rosbridge(self, robot: RosbridgeRobot) -> RosbridgeDriver:
        robot.start()
        connector = MemoryConnector(self.clock, robot.accept)
        return RosbridgeDriver({}, connector, self.clock, "robot", self.switch)

    def published(self, word: LastWord) -> dict[str, Any]:
        head, size = word.halt[0], word.halt[1]
        self.assertEqual(head, 0x81)
        at = 2 if size < 0x80 + 126 else 4
        self.assertGreaterEqual(size, 0x80)
        said = json.loads(masked(word.halt[at + 4 :], word.halt[at : at + 4]))
        self.assertEqual((said["op"], said["topic"]), ("publish", "/cmd_vel"))
        message: dict[str, Any] = said["msg"]
        velocity = message.get("twist", message)
        self.assertEqual({**velocity["linear"], "turn": velocity["angular"]["z"]}, {"x": 0, "y": 0, "z": 0, "turn": 0})
        return message

    def test_none_in_memory(self) -> None:
        """A driver over links of memory has no process beside it."""
        robot = Create2(self.body, self.clock, Random(1))
        connector = MemoryConnector(self.clock, robot.accept)
        driver = driver_for("create2", {"port": "x"}, "robot", self.clock, connector)
        self.assertNotIn("halts", driver.diagnostics())
