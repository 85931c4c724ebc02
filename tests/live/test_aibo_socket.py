"""Tests of an emulated dog and its driver over real loopback sockets, with frames over TCP and UDP."""

from __future__ import annotations

import random

from twisted.internet import reactor
from twisted.internet.interfaces import IReactorTime
from twisted.trial.unittest import TestCase

from drivers.aibo.driver import AiboDriver
from drivers.driver import Permit
from drivers.registry import create_driver
from sim.demo.free_ports import find_free_ports
from sim.robots.emulator.aibo import AiboServer
from sim.robots.emulator.aibo_dog import EMULATED_PORTS, AiboEmulator
from sim.robots.emulator.simulated_robot import MemoryRobot
from tests.live.waiting import wait
from tests.webnode.picture import jpeg


def free_ports() -> dict[str, int]:
    """Return an unused port number for each of the dog's ports."""
    return dict(zip(EMULATED_PORTS, find_free_ports("tcp", "127.0.0.1", len(EMULATED_PORTS)), strict=True))


class AiboSocketTests(TestCase):
    """Driver and emulator over sockets."""

    timeout = 30

    async def test_drives_and_films(self) -> None:
        """Over TCP and over UDP a dog connects, sends frames, walks, stops, survives a reboot and frees its ports."""
        for transport in ("tcp", "udp"):
            await self._drive(transport)

    async def _drive(self, transport: str) -> None:
        clock = IReactorTime(reactor)
        body = MemoryRobot(jpeg=jpeg())
        ports = free_ports()
        dog = AiboEmulator(clock, body, random.Random(1), ports=ports)
        server = AiboServer(reactor, dog)
        server.start()
        named = {service: number for service, number in ports.items() if service != "gains"}
        options = {"host": "127.0.0.1", "ports": named, "camera_transport": transport, "camera_fps": 30}
        driver = create_driver("aibo", options, "dog1", clock)
        assert isinstance(driver, AiboDriver)
        await driver.connect()
        self.assertTrue(await driver.enable())
        driver.act({"base.vx": 0.1}, Permit(1, clock.seconds() + 0.5))
        await wait(0.2)
        self.assertGreater(body.motion[0], 0.05)
        await wait(1.0)
        self.assertEqual(body.motion, (0.0, 0.0, 0.0))
        self.assertGreater(driver.diagnostics()["pictures"], 20, transport)
        self.assertEqual(driver.diagnostics()["bad_frames"], 0)
        dog.reboot()
        await wait(2.5)
        self.assertEqual((driver.state, driver.diagnostics()["reconnects"]), ("ready", 1))
        await driver.disconnect()
        await wait(0.2)
        self.assertTrue(dog.is_engaged)
        self.assertEqual(dog.clients, {})
        await server.stop()
