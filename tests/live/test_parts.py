"""Tests of one device that consists of a robot on a serial port, a network camera and a compass."""

from __future__ import annotations

from collections.abc import Generator
from importlib.util import find_spec
from random import Random
from typing import Any

from twisted.internet import reactor as running
from twisted.internet.defer import Deferred, inlineCallbacks
from twisted.internet.task import deferLater
from twisted.trial.unittest import TestCase

from drivers.driver import Permit
from drivers.link import TcpLinkFactory
from drivers.reading import Observation
from drivers.registry import create_driver
from middleware.config.settings import Settings
from sim.robots.emulator.camera import MjpegCamera
from sim.robots.emulator.compass import NmeaCompass
from sim.robots.emulator.create2 import Create2
from sim.robots.emulator.pty import PtyPort
from sim.robots.emulator.simulated_robot import MemoryRobot
from tests.drivers.test_camera_driver import jpeg

reactor: Any = running

NODE = {"name": "vacuum"}


class LivePartsTests(TestCase):
    """Real sockets and a real terminal in real time."""

    timeout = 30

    @inlineCallbacks
    def test_is_one_device(self) -> Generator[Deferred[Any], Any, None]:
        """Robot, camera and compass have different kinds of links.

        The camera is lost and reconnects while the robot drives.
        """
        body = MemoryRobot(jpeg=jpeg(5), values={"compass.heading": 0.5})
        robot, camera, compass = (
            Create2(body, reactor, Random(1)),
            MjpegCamera(reactor, body),
            NmeaCompass(reactor, body),
        )
        cable = PtyPort(reactor, robot.accept)
        ports = [reactor.listenTCP(0, TcpLinkFactory(one.accept), interface="127.0.0.1") for one in (camera, compass)]
        camera.start()
        compass.start()
        watching, listening = (port.getHost().port for port in ports)
        parts = [
            {"kind": "camera", "options": {"url": f"http://127.0.0.1:{watching}/stream"}},
            {"kind": "compass", "options": {"host": "127.0.0.1", "port": listening}},
        ]
        table = {"kind": "create2", "options": {"port": cable.path}, "parts": parts}
        wanted = Settings.from_mapping({"node": NODE, "driver": table}, "vacuum.toml").driver
        driver = create_driver(wanted.kind, wanted.options, "vacuum", reactor, parts=wanted.parts)

        def newest() -> Observation:
            seen = driver.observe()
            assert seen is not None
            return seen

        try:
            yield driver.connect()
            yield driver.enable()
            while newest().frame is None or "compass.heading" not in newest().values:
                yield deferLater(reactor, 0.02)
            self.assertAlmostEqual(float(newest().values["compass.heading"]), 0.5, 2)
            driver.act({"base.vx": 0.2}, Permit(1, reactor.seconds() + 5.0))
            camera.clients[0].link.close()
            while newest().frame is not None:
                yield deferLater(reactor, 0.02)
            self.assertEqual((driver.state, driver.diagnostics()["camera.reconnects"]), ("ready", 0))
            self.assertGreater(body.motion[0], 0.1)
            while newest().frame is None:
                yield deferLater(reactor, 0.02)
            self.assertEqual(driver.diagnostics()["camera.reconnects"], 1)
        finally:
            yield driver.disconnect()
            camera.stop()
            compass.stop()
            robot.stop()
            cable.close()
            for port in ports:
                yield port.stopListening()
            yield deferLater(reactor, 0.05)
        self.assertEqual(body.motion, (0.0, 0.0, 0.0))

    if find_spec("serial") is None:
        test_is_one_device.skip = "ROBOTS WITH PARTS ARE NOT TESTED: install the extra serial"  # type: ignore[attr-defined]
