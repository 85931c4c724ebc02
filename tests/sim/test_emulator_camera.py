"""Tests of ``sim.robots.emulator.camera``."""

from __future__ import annotations

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from drivers.camera.codec import StreamReader, encode_request
from sim.robots.emulator.camera import MjpegCamera
from sim.robots.emulator.simulated_robot import MemoryRobot
from tests.drivers.contract import KeptLink


class MjpegCameraTests(SynchronousTestCase):
    def setUp(self) -> None:
        """Start a camera with 8 pictures per second."""
        self.clock = Clock()
        self.body = MemoryRobot(jpeg=b"\xff\xd8a\xff\xd9")
        self.camera = MjpegCamera(self.clock, self.body, 8.0)
        self.camera.start()
        self.camera.start()

    def tearDown(self) -> None:
        """After ``stop`` no timer is left."""
        self.camera.stop()
        self.camera.stop()
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def pictures(self, wire: KeptLink) -> list[bytes]:
        return StreamReader().read(wire.said)

    def test_serves_several_clients(self) -> None:
        """After its request, for any path, each client gets every picture until the client leaves."""
        first, second = KeptLink(), KeptLink()
        asks = self.camera.accept(first)
        for byte in encode_request("cam", "/stream"):
            asks.data_received(bytes([byte]))
        self.clock.pump([0.0625] * 16)
        self.camera.accept(second).data_received(encode_request("cam", "/any?thing=1"))
        asks.data_received(b"what comes later is not heard")
        self.clock.pump([0.0625] * 16)
        self.assertEqual((len(self.pictures(first)), len(self.pictures(second))), (16, 8))
        asks.link_down()
        asks.link_down()
        self.clock.pump([0.0625] * 16)
        self.assertEqual((len(self.pictures(first)), len(self.pictures(second))), (16, 16))

    def test_drops_for_a_busy_client(self) -> None:
        """A picture for a busy client is dropped as a whole; other clients lose no picture."""
        slow, quick = KeptLink(), KeptLink()
        for wire in (slow, quick):
            self.camera.accept(wire).data_received(encode_request("cam", "/"))
        slow.is_busy = True
        self.clock.pump([0.0625] * 16)
        slow.is_busy = False
        self.clock.pump([0.0625] * 16)
        self.assertEqual((len(self.pictures(slow)), len(self.pictures(quick)), self.camera.dropped), (8, 16, 8))

    def test_turns_away(self) -> None:
        """A wrong method, an endless request, and a request to a camera that is out of order get no pictures."""
        posts, endless, late = KeptLink(), KeptLink(), KeptLink()
        self.camera.accept(posts).data_received(b"POST / HTTP/1.1\r\n\r\n")
        self.camera.accept(endless).data_received(bytes(10_000))
        self.camera.status = "503 Busy"
        self.camera.accept(late).data_received(encode_request("cam", "/"))
        self.clock.pump([0.0625] * 16)
        self.assertTrue(posts.said.startswith(b"HTTP/1.1 405 ") and late.said.startswith(b"HTTP/1.1 503 "))
        self.assertEqual((endless.said, endless.is_closed), (b"", True))
        self.camera.stop()
        self.assertTrue(posts.is_closed and late.is_closed)
