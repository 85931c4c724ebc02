"""Tests of the robot simulator as a process, over real loopback sockets."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from twisted.internet import reactor
from twisted.internet.interfaces import IReactorTime
from twisted.trial.unittest import SynchronousTestCase, TestCase

import sim
from drivers.driver import Permit
from drivers.errors import UsageError
from drivers.link import TcpConnector
from drivers.registry import create_driver
from drivers.sim.client import SimulatorClient
from tests.live.waiting import wait

ROOT = Path(sim.__file__).parents[1]


def spawned(*arguments: str) -> subprocess.Popen[str]:
    """Start a simulator process; its first line contains the address."""
    return subprocess.Popen(
        [sys.executable, "-m", "sim.robots.server", *arguments],
        cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


@asynccontextmanager
async def running_yard() -> AsyncIterator[tuple[subprocess.Popen[str], int]]:
    """Run a simulator process on a free port."""
    process = spawned("--port", "0")
    assert process.stdout is not None
    line = process.stdout.readline()
    try:
        yield process, int(line.split(" on ")[1].split(":")[1])
    finally:
        process.kill()
        process.communicate()


class SimulatorSocketTests(TestCase):
    """A driver and an operator, each connected over TCP."""

    timeout = 20

    async def test_drives_a_dog(self) -> None:
        """Over TCP a dog connects, senses, walks and stops; the operator moves the target; both disconnect."""
        clock = IReactorTime(reactor)
        async with running_yard() as (_, port):
            driver = create_driver("sim", {"port": port, "camera_fps": 30}, "dog1", clock)
            operator = SimulatorClient(TcpConnector(), clock, port=port)
            await driver.connect()
            before = await operator.connect()
            await driver.enable()
            driver.act({"base.vx": 0.16}, Permit(1, clock.seconds() + 0.5))
            await wait(1.0)
            after = operator.snapshot
            assert after is not None
            moved = after["dogs"][0]["x"] - before["dogs"][0]["x"]
            self.assertTrue(0.02 < moved < 0.1, moved)
            self.assertFalse(after["dogs"][0]["moving"])
            newest = driver.observe()
            assert newest is not None and newest.frame is not None
            self.assertGreater(newest.frame.seq, 15)
            await operator.place_target(1.5, 1.2)
            with self.assertRaises(UsageError):
                await operator.place_target(-1.0, 0.0)
            await driver.disconnect()
            await operator.disconnect()

    async def test_opens_a_lost_link_again(self) -> None:
        """If the simulator is killed, the driver becomes stale; it reconnects to a new simulator on the same port."""
        clock = IReactorTime(reactor)
        async with running_yard() as (process, port):
            driver = create_driver("sim", {"port": port, "camera": False}, "dog2", clock)
            await driver.connect()
            process.kill()
            process.wait()
            await wait(0.2)
            self.assertEqual(driver.state, "stale")
        again = spawned("--port", str(port))
        try:
            for _ in range(80):
                await wait(0.1)
                if driver.state == "ready":
                    break
            self.assertEqual(driver.state, "ready")
        finally:
            await driver.disconnect()
            again.kill()
            again.communicate()


class SimulatorCommandTests(SynchronousTestCase):
    """Errors of the command line."""

    def refusal(self, *arguments: str) -> str:
        """Return the error line of a simulator that does not start."""
        process = spawned(*arguments)
        _, line = process.communicate(timeout=20)
        self.assertEqual((process.returncode, line.count("\n")), (2, 1), line)
        return line

    def test_names_the_mistake(self) -> None:
        """For an unknown scene or an invalid port the exit code is 2, and one line lists the valid values."""
        self.assertIn("known are three-dogs", self.refusal("--scene", "nowhere"))
        self.assertIn("1 to 65535", self.refusal("--port", "70000"))

    def test_names_an_address_of_another(self) -> None:
        """For an address of another machine, or an invalid one, the exit code is 2.

        The error asks for a valid address.
        """
        for host in ("192.0.2.1", "300.1.1.1"):
            said = self.refusal("--host", host, "--port", "0")
            self.assertIn(f"cannot listen on {host}:0: ", said)
            self.assertTrue(said.endswith("; give --host an address of this machine\n"), said)

    def test_names_a_port_in_use(self) -> None:
        """A second simulator on the same port ends with code 2; the error contains the port."""
        first = spawned("--port", "0")
        try:
            assert first.stdout is not None
            port = first.stdout.readline().split(" on ")[1].split(":")[1].strip()
            said = self.refusal("--port", port)
            self.assertIn(
                f"swarm simulator: cannot listen on 127.0.0.1:{port}: Address already in use; try another", said
            )
        finally:
            first.kill()
            first.communicate()
