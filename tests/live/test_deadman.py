"""Tests of the dead man's switch with real processes: a program that drives an emulated robot is frozen or killed.

The robots are in this process, behind real sockets and pseudo-terminals; the driving program is a child process.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from random import Random
from typing import Any

from twisted.internet import reactor
from twisted.trial.unittest import SkipTest, TestCase

from drivers.deadman.process import now
from drivers.deadman.supervisor import Supervisor
from drivers.deadman.switch import HaltCommand
from drivers.link import TcpLinkFactory
from sim.robots.emulator.aibo import AiboServer
from sim.robots.emulator.aibo_dog import AiboEmulator
from sim.robots.emulator.bittle import Bittle
from sim.robots.emulator.create2 import Create2
from sim.robots.emulator.pty import PtyPort
from sim.robots.emulator.rosbridge import RosbridgeRobot
from sim.robots.emulator.simulated_robot import MemoryRobot
from tests.drivers.contract import KeptLog
from tests.live.test_aibo_socket import free_ports
from tests.live.waiting import CLOCK, until, wait

if not Path("/proc/self/stat").exists():
    raise SkipTest("the test needs /proc")
HAS_SERIAL = find_spec("serial") is not None

ROOT = Path(__file__).resolve().parents[2]
REACTOR: Any = reactor
LATE_S = 0.4
"""The maximum time in seconds until the robot stands still after its deadline or the end of its node."""


@dataclass
class TimedBody(MemoryRobot):
    """A base that records its motions and their times."""

    told: list[tuple[float, tuple[float, float, float]]] = field(default_factory=list)

    def drive(self, vx: float, vy: float, wz: float) -> None:
        super().drive(vx, vy, wz)
        self.told.append((now(), self.motion))

    def halt(self) -> None:
        super().halt()
        self.told.append((now(), self.motion))

    @property
    def is_moving(self) -> bool:
        return any(self.motion)

    def rested_at(self) -> float:
        """Return the time of the last stop."""
        moving = [place for place, (_, motion) in enumerate(self.told) if any(motion)]
        return self.told[moving[-1] + 1][0]


def is_alive(pid: int) -> bool:
    """Return whether the process exists and is not a zombie."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def ignores_signals(pid: int) -> bool:
    """Return whether the process has started to ignore SIGTERM."""
    status = Path(f"/proc/{pid}/status").read_text()
    return bool(int(status.partition("SigIgn:")[2].split()[0], 16) >> (signal.SIGTERM - 1) & 1)


class Puppeteer:
    """Starts the driving program in a new session and reads its output."""

    def __init__(self, path: str, kind: str, options: dict[str, object]) -> None:
        self._path = Path(path)
        command = [sys.executable, "-m", "tests.live.puppet", kind, json.dumps(options)]
        with open(path, "wb") as output:
            self.process = subprocess.Popen(
                command, cwd=ROOT, stdin=subprocess.PIPE, stdout=output, start_new_session=True
            )

    async def said(self, word: str, count: int = 1) -> list[str]:
        """Wait until ``count`` lines start with this word; return the last of these lines without the word."""
        found: list[list[str]] = []

        def is_said() -> bool:
            lines = [line.split() for line in self._path.read_text().splitlines()]
            found[:] = [line[1:] for line in lines if line[0] == word]
            return len(found) >= count

        await until(is_said, 20.0)
        return found[count - 1]

    def tell(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line.encode() + b"\n")
        self.process.stdin.flush()

    async def switch(self) -> tuple[int, float]:
        """Return the process id of the switch, and the number of halts that it sent."""
        count = self._path.read_text().count("switch") + 1
        self.tell("switch")
        pid, halts = await self.said("switch", count)
        return int(pid), float(halts)

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        assert self.process.stdin is not None
        self.process.stdin.close()


class DeadManCase(TestCase):
    """A test case with one robot and a driving program that may be frozen."""

    timeout = 60

    def setUp(self) -> None:
        self.body = TimedBody()
        self.puppeteers: list[Puppeteer] = []
        self.addCleanup(self.leave)

    async def leave(self) -> None:
        for one in self.puppeteers:
            one.end()

    async def driven(self, kind: str, **options: object) -> Puppeteer:
        """Return a driving program with a connected and enabled driver."""
        puppeteer = Puppeteer(self.mktemp(), kind, options)
        self.puppeteers.append(puppeteer)
        await puppeteer.said("ready")
        return puppeteer

    async def walking(self, puppeteer: Puppeteer, seconds: float, count: int = 1) -> float:
        """Let the robot walk; return the deadline of the motion."""
        puppeteer.tell(f"walk {seconds}")
        (deadline,) = await puppeteer.said("walking", count)
        await until(lambda: self.body.is_moving)
        return float(deadline)

    async def freeze(self, puppeteer: Puppeteer, permitted: float = 0.5) -> None:
        """Freeze the program during a motion: the robot stops in time, and moves again only with a new permit."""
        deadline = await self.walking(puppeteer, permitted)
        puppeteer.process.send_signal(signal.SIGSTOP)
        await wait(deadline - now() + 0.5)
        self.assertFalse(self.body.is_moving)
        rested = self.body.rested_at()
        self.assertGreater(rested, deadline)
        self.assertLess(rested, deadline + LATE_S)
        puppeteer.process.send_signal(signal.SIGCONT)
        await wait(1.0)
        self.assertEqual(self.body.rested_at(), rested)
        self.assertGreaterEqual((await puppeteer.switch())[1], 1)
        await self.walking(puppeteer, 0.3, 2)
        await until(lambda: not self.body.is_moving, 2.0)

    async def kill(self, puppeteer: Puppeteer) -> None:
        """Kill the program during a motion: the robot stops immediately, and the switch ends within a second."""
        pid, _ = await puppeteer.switch()
        await self.walking(puppeteer, 5.0)
        killed = now()
        puppeteer.process.kill()
        await until(lambda: not self.body.is_moving, 2.0)
        self.assertLess(self.body.rested_at() - killed, LATE_S)
        await until(lambda: not is_alive(pid), killed + 1.0 - now())
        puppeteer.process.wait()


class Wire:
    """A link over a pair of sockets; ``far`` is the end of the robot."""

    def __init__(self) -> None:
        self.is_busy = False
        self.near, self.far = socket.socketpair()
        self.far.setblocking(False)
        self.near.setblocking(False)

    def fileno(self) -> int:
        return self.near.fileno()

    def send(self, data: bytes) -> None:
        self.near.send(data)

    def close(self) -> None:
        self.near.close()
        self.far.close()

    def heard(self) -> bytes | None:
        """Return the data that has arrived at the robot, or None if the link is closed."""
        try:
            return self.far.recv(1 << 20) or None
        except BlockingIOError:
            return b""


class KeeperTests(TestCase):
    """The switch and the keeper that starts it, without a robot."""

    timeout = 30

    def setUp(self) -> None:
        self.wire = Wire()
        self.keeper = Supervisor("robot", reactor)
        self.addCleanup(self.leave)

    async def leave(self) -> None:
        await self.keeper.close()
        self.wire.close()

    async def test_halts_and_counts(self) -> None:
        """At the deadline the switch sends the halt three times, and the keeper counts one halt."""
        self.keeper.set_halt_command(HaltCommand(b"halt", self.wire))
        self.keeper.arm(0.2)
        await wait(0.15)
        self.assertEqual(self.wire.heard(), b"")
        await wait(0.6)
        self.assertEqual(self.wire.heard(), b"halt" * 3)
        self.assertEqual(self.keeper.halts, 1)

    async def test_stays_armed_until_the_halt_has_left(self) -> None:
        """``disarm`` takes effect only after the link has sent the driver's halt."""
        self.keeper.set_halt_command(HaltCommand(b"halt", self.wire))
        self.keeper.arm(0.2)
        self.keeper.disarm()
        await wait(0.4)
        self.assertEqual(self.wire.heard(), b"")
        self.wire.is_busy = True
        self.keeper.arm(0.2)
        self.keeper.disarm()
        await wait(0.5)
        self.assertEqual(self.wire.heard(), b"halt" * 3)
        self.wire.is_busy = False

    async def test_lets_go_of_the_link(self) -> None:
        """When the driver closes a link and the switch releases it, the link is also closed at the robot's end."""
        self.keeper.set_halt_command(HaltCommand(b"halt", self.wire))
        await wait(0.1)
        self.wire.near.close()
        self.assertEqual(self.wire.heard(), b"")
        self.keeper.on_link_lost()
        await until(lambda: self.wire.heard() is None, 1.0)

    async def test_leaves_no_timer_once_closed(self) -> None:
        """If a link is lost after ``close``, no timer starts."""
        self.keeper.set_halt_command(HaltCommand(b"halt", self.wire))
        self.keeper.arm(1.0)
        await self.keeper.close()
        self.keeper.disarm()
        self.keeper.on_link_lost()

    async def test_finishes_a_halt_that_left_in_part(self) -> None:
        """A partly sent halt is completed before it is repeated."""
        self.wire.near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4608)
        halt = bytes(range(250)) * 40
        self.keeper.set_halt_command(HaltCommand(halt, self.wire))
        self.keeper.arm(0.05)
        await until(lambda: self.keeper.halts == 1)
        said = self.wire.heard() or b""
        self.assertLess(len(said), len(halt))
        await wait(0.15)
        said += self.wire.heard() or b""
        self.assertEqual(said[: len(halt)], halt)
        self.assertEqual(said[len(halt) :], halt[: len(said) - len(halt)])

    async def test_replaces_one_that_does_not_listen(self) -> None:
        """A stopped switch with a full socket is killed and replaced, and the keeper does not block."""
        self.keeper.set_halt_command(HaltCommand(b"halt", self.wire))
        first = self.keeper.pid
        assert first is not None
        os.kill(first, signal.SIGSTOP)
        began = now()
        for _ in range(50_000):
            self.keeper.arm(5.0)
        self.assertLess(now() - began, 5.0)
        await until(lambda: self.keeper.pid not in (None, first), 3.0)
        self.assertFalse(Path(f"/proc/{first}").exists())
        self.keeper.arm(0.1)
        await until(lambda: self.wire.heard() == b"halt", 1.0)

    async def test_names_what_cannot_be_started(self) -> None:
        """If no switch can be started, or each switch ends immediately, the keeper logs this once and retries."""
        for program, words in (
            ("/nowhere/python", "dead man's switch did not start"),
            ("/bin/false", "restarting it"),
        ):
            self.keeper = Supervisor("robot", reactor)
            self.keeper.log = log = KeptLog()  # type: ignore[assignment]
            good, sys.executable = sys.executable, program
            try:
                self.keeper.set_halt_command(HaltCommand(b"halt", self.wire))
                self.keeper.arm(5.0)
                await wait(0.5)
            finally:
                sys.executable = good
            self.assertEqual(len(log.lines), 1)
            self.assertIn(words, log.lines[0])
            await wait(1.0)
            self.keeper.arm(0.1)
            await until(lambda: self.wire.heard() == b"halt", 1.0)
            await self.keeper.close()
            await wait(0.05)
            self.wire.heard()

    async def test_ends_at_any_moment(self) -> None:
        """A keeper leaves no process running, whether it is closed before, during or after a start, once or twice."""
        for stage in range(4):
            keeper = Supervisor("robot", reactor)
            if stage:
                keeper.set_halt_command(HaltCommand(b"halt", self.wire))
                keeper.arm(5.0)
            pid = keeper.pid
            if stage == 2:
                os.kill(pid or 0, signal.SIGKILL)
                await until(lambda keeper=keeper: keeper.pid is None, 1.0)  # type: ignore[misc]
            elif stage == 3:
                os.kill(pid or 0, signal.SIGSTOP)  # a stopped process, which does not receive the end
            await keeper.close()
            await keeper.close()
            self.assertFalse(pid and Path(f"/proc/{pid}").exists())
            self.assertEqual(self.wire.heard(), b"")


class AiboDeadManTests(DeadManCase):
    """An AIBO, which without a switch would walk on for three seconds."""

    def setUp(self) -> None:
        super().setUp()
        ports = free_ports()
        dog = AiboEmulator(CLOCK, self.body, Random(1), ports=ports)
        self.dog = dog
        self.server = AiboServer(reactor, dog)
        self.server.start()
        named = {service: number for service, number in ports.items() if service != "gains"}
        self.options: dict[str, object] = {"host": "127.0.0.1", "ports": named, "camera": False}

    async def leave(self) -> None:
        await super().leave()
        await until(lambda: not self.dog.clients)
        await self.server.stop()

    async def test_frozen(self) -> None:
        """If the program is stopped (SIGSTOP), the dog stops after the deadline, and stands until a new permit."""
        await self.freeze(await self.driven("aibo", **self.options))

    async def test_killed(self) -> None:
        """If the program is killed, the dog stops immediately, and the switch ends."""
        await self.kill(await self.driven("aibo", **self.options))

    async def test_interrupted(self) -> None:
        """On Ctrl-C and SIGTERM the switch outlives its program.

        Then the switch also ends, and the dog stands still.
        """
        puppeteer = await self.driven("aibo", **self.options)
        pid, _ = await puppeteer.switch()
        await until(lambda: ignores_signals(pid))
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(pid, number)
        await self.walking(puppeteer, 5.0)
        self.assertTrue(is_alive(pid))
        os.killpg(puppeteer.process.pid, signal.SIGINT)
        await until(lambda: puppeteer.process.poll() is not None, 5.0)
        self.assertFalse(self.body.is_moving)
        self.assertFalse(Path(f"/proc/{pid}").exists())

    async def test_replaced(self) -> None:
        """A switch that is killed during a walk is replaced, and the new switch halts the dog in time."""
        puppeteer = await self.driven("aibo", **self.options)
        first, _ = await puppeteer.switch()
        deadline = await self.walking(puppeteer, 2.0)
        os.kill(first, signal.SIGKILL)
        await wait(0.5)
        second, _ = await puppeteer.switch()
        self.assertNotIn(second, (0, first))
        self.assertFalse(Path(f"/proc/{first}").exists())
        puppeteer.process.send_signal(signal.SIGSTOP)
        await wait(deadline - now() + 0.3)
        self.assertFalse(self.body.is_moving)
        self.assertLess(self.body.rested_at(), deadline + LATE_S)
        puppeteer.process.send_signal(signal.SIGCONT)

    async def test_lost_link(self) -> None:
        """The switch releases a lost link, because the dog accepts only one client, and guards the next link."""
        puppeteer = await self.driven("aibo", **self.options)
        self.dog.reboot()
        await wait(2.5)
        await self.freeze(puppeteer)


class Create2DeadManTests(DeadManCase):
    """A Create 2 on a serial port, which without a switch would drive on."""

    if not HAS_SERIAL:
        skip = "needs the extra serial"

    def setUp(self) -> None:
        super().setUp()
        self.robot = Create2(self.body, CLOCK, Random(1))
        self.port = PtyPort(reactor, self.robot.accept)

    async def leave(self) -> None:
        await super().leave()
        self.port.close()
        self.robot.stop()

    async def test_frozen(self) -> None:
        """If the program is stopped, the robot stops after its deadline."""
        await self.freeze(await self.driven("create2", port=self.port.path))

    async def test_killed(self) -> None:
        """If the program is killed, the robot stops immediately, and the serial port is free."""
        await self.kill(await self.driven("create2", port=self.port.path))
        await self.driven("create2", port=self.port.path)


class BittleDeadManTests(DeadManCase):
    """A Bittle, which without a switch would walk on."""

    async def test_frozen_on_a_cable(self) -> None:
        """If the program is stopped, the dog stops after its deadline."""
        if not HAS_SERIAL:
            raise SkipTest("needs the extra serial")
        robot = Bittle(self.body, CLOCK, Random(1))
        port = PtyPort(reactor, robot.accept)
        try:
            await self.freeze(await self.driven("bittle", port=port.path))
        finally:
            await self.leave()
            port.close()
            robot.stop()

    async def test_frozen_over_wifi(self) -> None:
        """Over HTTP the switch opens its own connection, for both boards."""
        for board in ("biboard", "nyboard"):
            robot = Bittle(self.body, CLOCK, Random(1), board=board)
            listening = REACTOR.listenTCP(0, TcpLinkFactory(robot.accept_http), interface="127.0.0.1")
            try:
                port = listening.getHost().port
                await self.freeze(await self.driven("bittle", host="127.0.0.1", http_port=port, board=board), 1.0)
            finally:
                await self.leave()
                await listening.stopListening()
                robot.stop()
                await wait(0.1)


class Restless(RosbridgeRobot):
    """A robot that has no timeout in its base."""

    def _on_no_command(self) -> None:
        """Keep moving."""


class RosbridgeDeadManTests(DeadManCase):
    """A ROS robot that has no timeout in its base."""

    async def test_frozen(self) -> None:
        """If the program is stopped, the robot stops after its deadline."""
        robot = Restless(CLOCK, self.body, Random(1))
        robot.start()
        listening = REACTOR.listenTCP(0, TcpLinkFactory(robot.accept), interface="127.0.0.1")
        try:
            await self.freeze(await self.driven("rosbridge", host="127.0.0.1", port=listening.getHost().port))
        finally:
            await self.leave()
            await listening.stopListening()
            robot.stop()
            await wait(0.1)
