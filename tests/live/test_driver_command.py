"""Tests of ``swarm driver`` as a process, with an emulated dog on real sockets and a pseudo-terminal for its keys."""

from __future__ import annotations

import fcntl
import os
import pty
import random
import signal
import struct
import subprocess
import sys
import tempfile
import termios
from pathlib import Path
from typing import Any

from twisted.internet import reactor
from twisted.internet.interfaces import IReactorTime
from twisted.trial.unittest import TestCase

from sim.robots.emulator.aibo import AiboServer
from sim.robots.emulator.aibo_dog import AiboEmulator
from sim.robots.emulator.simulated_robot import MemoryRobot
from tests.live.test_aibo_socket import free_ports
from tests.live.waiting import wait
from tests.webnode.picture import jpeg

ROOT = Path(__file__).resolve().parents[2]
JPEG = jpeg()
COMMAND = [sys.executable, "-c", "import sys; from swarmnode.command import main; sys.exit(main())", "driver"]


class DriverCommandTests(TestCase):
    """Command, sockets and terminal are real; the dog is emulated."""

    timeout = 60

    def setUp(self) -> None:
        """Start a dog on ports of this machine."""
        clock = IReactorTime(reactor)
        self.body = MemoryRobot(jpeg=JPEG, values={"power.level": 0.8})
        ports = free_ports()
        self.dog = AiboEmulator(clock, self.body, random.Random(1), ports=ports)
        server = AiboServer(reactor, self.dog)
        server.start()
        self.addCleanup(server.stop)
        named = [f"ports.{service}={number}" for service, number in ports.items() if service != "gains"]
        options = [word for option in ("host=127.0.0.1", *named) for word in ("--option", option)]
        self.robot = ["--kind", "aibo", *options]
        self.folder = tempfile.TemporaryDirectory()
        self.addCleanup(self.folder.cleanup)

    def started(self, *words: str, **more: Any) -> subprocess.Popen[bytes]:
        """Start the command with these words; kill it after the test."""
        child = subprocess.Popen([*COMMAND, *words, *self.robot], cwd=ROOT, **more)
        self.addCleanup(child.wait)
        self.addCleanup(child.kill)
        return child

    async def ended(self, child: subprocess.Popen[bytes], seconds: float = 20.0) -> int:
        """Wait until a child process has ended; return its exit code."""
        until = IReactorTime(reactor).seconds() + seconds
        while child.poll() is None and IReactorTime(reactor).seconds() < until:
            await wait(0.02)
        self.assertIsNotNone(child.poll(), "it does not end")
        return int(child.returncode)

    async def set_off(self, keyboard: int) -> None:
        until = IReactorTime(reactor).seconds() + 10.0
        while self.body.motion[0] < 0.03 and IReactorTime(reactor).seconds() < until:
            os.write(keyboard, b"w")
            await wait(0.1)
        self.assertGreater(self.body.motion[0], 0.03)

    async def test_probe_and_monitor(self) -> None:
        """``probe`` prints data over TCP, ``monitor`` saves a frame, and a closed port is reported."""
        out = Path(self.folder.name) / "out"
        with out.open("wb") as file:
            self.assertEqual(await self.ended(self.started("probe", "--seconds", "1", stdout=file)), 0)
        self.assertIn("mode          T4", out.read_text())
        self.assertIn("power.level   80 %", out.read_text())
        picture = Path(self.folder.name) / "dog.jpg"
        words = ("monitor", "--seconds", "2", "--picture", str(picture))
        self.assertEqual(await self.ended(self.started(*words, stdout=subprocess.DEVNULL)), 0)
        self.assertEqual(picture.read_bytes(), JPEG)
        self.robot = ["--kind", "aibo", "--option", "host=127.0.0.1", "--option", "ports.main=1"]
        with out.open("wb") as file:
            self.assertEqual(await self.ended(self.started("probe", stdout=file)), 1)
        self.assertIn("! 127.0.0.1:1: nothing listens at this port", out.read_text())

    async def test_interrupted(self) -> None:
        """After Ctrl-C ``monitor`` and ``drive`` end without a traceback; the dog is at rest with its motors off."""
        out = Path(self.folder.name) / "out"
        with out.open("wb") as file:
            child = self.started("monitor", stdout=file, stderr=file)
            while b"ready" not in out.read_bytes():
                await wait(0.05)
            child.send_signal(signal.SIGINT)
            self.assertEqual(await self.ended(child), 0)
        self.assertNotIn("Traceback", out.read_text())
        ours, theirs = pty.openpty()
        self.addCleanup(os.close, ours)
        self.addCleanup(os.close, theirs)
        child = self.started("drive", stdin=theirs, stdout=theirs, stderr=theirs)
        await self.set_off(ours)
        child.send_signal(signal.SIGINT)
        self.assertEqual(await self.ended(child), 0)
        self.assertEqual((self.body.motion, self.dog.is_engaged), ((0.0, 0.0, 0.0), True))
        self.assertNotIn("Traceback", os.read(ours, 65536).decode())

    async def test_drive(self) -> None:
        """Keys in a terminal move the dog, which stops when no key is pressed.

        X ends the command and resets the terminal.
        """
        ours, theirs = pty.openpty()
        self.addCleanup(os.close, ours)
        self.addCleanup(os.close, theirs)
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))
        before = termios.tcgetattr(theirs)
        child = self.started("drive", stdin=theirs, stdout=theirs, stderr=theirs)
        await self.set_off(ours)
        moved = []
        for _ in range(8):
            os.write(ours, b"w")
            await wait(0.1)
            moved.append(self.body.motion[0])
        self.assertGreater(sum(vx > 0.03 for vx in moved), 4)
        await wait(0.8)
        self.assertEqual(self.body.motion, (0.0, 0.0, 0.0))
        os.write(ours, b"wx")
        self.assertEqual(await self.ended(child), 0)
        self.assertEqual((self.body.motion, self.dog.is_engaged), ((0.0, 0.0, 0.0), True))
        self.assertEqual(termios.tcgetattr(theirs), before)
        shown = os.read(ours, 65536).decode()
        self.assertIn("battery 80 %", shown)
        self.assertIn("space: stop", shown)
