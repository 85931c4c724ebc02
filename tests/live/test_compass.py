"""Headings over a real network and a real terminal, from the emulated compass to its driver."""

from __future__ import annotations

import math
from importlib.util import find_spec
from typing import Any

from twisted.internet import reactor as running
from twisted.trial.unittest import TestCase

from drivers.link import TcpLinkFactory
from drivers.registry import driver_for
from sim.robots.emulator.body import MemoryBody
from sim.robots.emulator.compass import NmeaCompass
from sim.robots.emulator.pty import PtyPort
from tests.live.waiting import wait

reactor: Any = running


class LiveCompassTests(TestCase):
    """Real sockets, real terminals, real time."""

    timeout = 30

    def setUp(self) -> None:
        """A compass that looks to the north."""
        self.compass = NmeaCompass(reactor, MemoryBody(values={"compass.heading": math.pi / 2}), 20.0)
        self.compass.start()

    async def follow(self, **options: object) -> None:
        """The heading arrives, does so again after the link was lost, and the end leaves nothing open."""
        driver = driver_for("compass", {"rate": 20, **options}, "dog", reactor)
        try:
            await driver.connect()
            seen = driver.observe()
            assert seen is not None
            self.assertAlmostEqual(float(seen.values["compass.heading"]), math.pi / 2, 6)
            if "host" in options:
                self.compass.clients[0].link.close()
                while driver.diagnostics()["reconnects"] < 1:
                    await wait(0.02)
        finally:
            await driver.disconnect()

    async def test_over_the_network(self) -> None:
        """Over TCP, a link that is lost is opened again."""
        port = reactor.listenTCP(0, TcpLinkFactory(self.compass.accept), interface="127.0.0.1")
        await self.follow(host="127.0.0.1", port=port.getHost().port)
        self.compass.stop()
        await port.stopListening()
        await wait(0.05)

    async def test_on_a_cable(self) -> None:
        """Over a serial device."""
        port = PtyPort(reactor, self.compass.accept)
        await self.follow(device=port.path)
        self.compass.stop()
        port.close()

    if find_spec("serial") is None:
        test_on_a_cable.skip = "NO CABLE IS TRIED: install the extra serial"  # type: ignore[attr-defined]
