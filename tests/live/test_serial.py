"""Tests of the serial robots' drivers over real pseudo-terminals, with emulators at the other end."""

from __future__ import annotations

import os
from random import Random

from twisted.internet import reactor
from twisted.trial.unittest import SkipTest, TestCase

from drivers.create2.driver import Create2Driver
from drivers.create2.option import parse_options
from drivers.driver import Driver, Permit
from drivers.errors import NotEnabled
from drivers.registry import create_driver
from drivers.serial import SerialConnector
from sim.robots.emulator.create2 import Create2
from sim.robots.emulator.pty import PtyPort
from sim.robots.emulator.simulated_robot import MemoryRobot
from tests.live.waiting import CLOCK, until

try:
    import serial  # noqa: F401
except ImportError as missing:
    raise SkipTest("needs the extra serial") from missing


class Create2PtyTests(TestCase):
    """A Create 2 on a pseudo-terminal."""

    timeout = 30

    def setUp(self) -> None:
        self.body = MemoryRobot()
        self.robot = Create2(self.body, CLOCK, Random(1))
        self.path = self.mktemp()
        self.port = PtyPort(reactor, self.robot.accept, self.path)
        self.drivers: list[Driver] = []
        self.addCleanup(self.leave)

    async def leave(self) -> None:
        for driver in self.drivers:
            await driver.disconnect()
        self.port.close()
        self.robot.stop()

    def driver(self) -> Create2Driver:
        driver = create_driver("create2", {"port": self.path}, "vacuum", CLOCK)
        self.drivers.append(driver)
        assert isinstance(driver, Create2Driver)
        return driver

    async def test_outlives_a_pulled_cable(self) -> None:
        """When the cable is unplugged, the driver is stale and reports the missing device.

        When the cable is plugged in, the driver is ready again.
        """
        driver = self.driver()
        await driver.connect()
        await driver.enable()
        self.port.close()
        await until(lambda: driver.state == "stale")
        await until(lambda: "does not exist" in driver.problem)
        self.port = PtyPort(reactor, self.robot.accept, self.path)

        def obeys() -> bool:
            try:
                driver.act({"base.vx": 0.1}, Permit(1, CLOCK.seconds() + 0.3))
            except NotEnabled:
                return False
            return True

        await until(obeys)
        self.assertEqual((driver.state, self.robot.mode), ("ready", 2))

    async def test_names_a_busy_port(self) -> None:
        """A second driver of a port reports that the port is busy, and connects after the first has disconnected."""
        first, second = self.driver(), self.driver()
        await first.connect()
        connected = second.connect()
        await until(lambda: "busy" in second.problem)
        await first.disconnect()
        await connected
        self.assertEqual(second.problem, "")

    async def test_names_what_is_no_port(self) -> None:
        """A file that is not a serial device, and a device without permission, are reported."""
        plain = self.mktemp()
        with open(plain, "wb"):
            pass
        await self.named(plain, "not a serial device")
        if os.geteuid() != 0:  # root may open every file
            os.chmod(os.path.realpath(self.path), 0)
            await self.named(self.path, "no permission")

    async def named(self, path: str, words: str) -> None:
        """Wait until the problem of a driver with this path contains these words."""
        driver = Create2Driver(parse_options({"port": path}), "vacuum", SerialConnector(), CLOCK)
        driver.connect().addErrback(lambda _: None)
        self.drivers.append(driver)
        await until(lambda: words in driver.problem)
