"""Tests of ``drivers.aibo.option``, its commands for main control, and its reconnection delays."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.error import ConnectionDone, ConnectionRefusedError
from twisted.internet.task import Clock
from twisted.internet.testing import MemoryReactorClock
from twisted.python.failure import Failure
from twisted.trial.unittest import SynchronousTestCase

from drivers.aibo import menu
from drivers.aibo.link import RETRY_DELAYS_S, Port
from drivers.aibo.option import PORTS, parse_options
from drivers.link import Link, TcpConnector
from drivers.registry import describe
from swarmnode.driver.environment import WarningCollector


class AiboOptionTests(SynchronousTestCase):
    """Options in the configuration."""

    def test_overrides_what_is_given(self) -> None:
        """An option for a port replaces only that port.

        If an option switches the camera off, the description has no camera.
        """
        self.assertEqual(parse_options({"host": "10.0.0.1", "camera_transport": "udp"}).camera_transport, "udp")
        self.assertEqual(parse_options({"host": "dog1", "ports": {"walk": 5}}).ports, {**PORTS, "walk": 5})
        self.assertIn("camera", describe("aibo", {"host": "dog1"}).capabilities)
        self.assertNotIn("camera", describe("aibo", {"host": "dog1", "camera": False}).capabilities)
        self.assertEqual(describe("aibo", {"host": "d", "speed": [1, 2, 3, 4]}).limits["base.vx"], (-2.0, 1.0))


class RecipeTests(SynchronousTestCase):
    """Commands for main control."""

    def test_sends_every_name(self) -> None:
        """Each server is started and stopped under all its names, after the settings were sent in both spellings."""
        lines = menu.make_start_commands(["walk", "camera"], "tcp", 30.0)
        self.assertEqual(
            lines,
            [
                "!set main.worldState_interval=0",
                "!set vision.rawcam.transport=TCP",
                "!set vision.rawcam.encoding=color",
                "!set vision.rawcam.compression=jpeg",
                "!set vision.rawcam.y_skip=2",
                "!set vision.rawcam.uv_skip=3",
                "!set vision.rawcam_y_skip=2",
                "!set vision.rawcam_uv_skip=3",
                "!set vision.rawcam.interval=0",
                "!set vision.rawcam_interval=0",
                '!select "Walk Remote Control"',
                '!select "WalkController"',
                '!select "Raw Cam Server"',
                '!select "RawCam"',
                "!hello",
            ],
        )
        self.assertEqual(
            menu.make_stop_commands(["walk"]), ['!select "#Walk Remote Control"', '!select "#WalkController"']
        )
        self.assertEqual(menu.make_greeting(), ["!hello", "!dump_stack", "!refresh"])

    def test_size(self) -> None:
        """The requested width appears in the description and selects the resolution layer that the dog sends."""
        self.assertEqual(
            menu.make_size_commands(208)[:2], ["!set vision.rawcam.y_skip=1", "!set vision.rawcam.uv_skip=2"]
        )
        camera = describe("aibo", {"host": "d", "camera_width": 208}).capabilities["camera"]
        self.assertEqual((camera["width"], camera["height"]), (208, 160))

    def test_waits_between_pictures(self) -> None:
        """Fifteen frames a second need a delay of 50 ms, counted from the end of the previous frame."""
        for fps, wait in ((30.0, 0), (0.0, 0), (15.0, 50), (10.0, 83)):
            self.assertEqual(menu.make_rate_commands(fps)[0], f"!set vision.rawcam.interval={wait}")


class _Client:
    def link_up(self, link: Link) -> None:
        """Do nothing."""

    def link_down(self) -> None:
        """Do nothing."""

    def data_received(self, data: bytes) -> None:
        """Ignore the data."""


class WaitTests(SynchronousTestCase):
    """The delays between connection attempts."""

    def test_waits_as_the_dogs_own_clients_do(self) -> None:
        """After refusals the delays are 0.5, 1, 2, 5 and 5 s; after received data the next delay is 0.5 s again."""
        reactor: Any = MemoryReactorClock()
        line = TcpConnector(reactor, RETRY_DELAYS_S).connect("dog1", 10050, _Client())
        for wait in (0.5, 1.0, 2.0, 5.0, 5.0):
            self.refuse(reactor)
            self.assertEqual([call.getTime() - reactor.seconds() for call in reactor.getDelayedCalls()], [wait])
            reactor.advance(wait)
        factory = reactor.tcpClients[0][2]
        factory.buildProtocol(None).dataReceived(b"off\n")
        self.lose(reactor)
        self.assertEqual([call.getTime() - reactor.seconds() for call in reactor.getDelayedCalls()], [0.5])
        line.disconnect()
        self.assertEqual(reactor.getDelayedCalls(), [])

    def test_does_not_pester_what_hangs_up_at_once(self) -> None:
        """The delays grow if the peer closes each connection immediately; a longer connection resets the delays."""
        for waits, wanted in ((RETRY_DELAYS_S, [0.5, 1.0, 2.0, 5.0, 5.0]), ((), [0.1, 0.16, 0.256, 0.4096, 0.65536])):
            reactor: Any = MemoryReactorClock()
            line: Any = TcpConnector(reactor, waits).connect("dog1", 10050, _Client())
            factory = reactor.tcpClients[0][2]
            found = []
            for _ in wanted:
                factory.buildProtocol(None)
                self.assertEqual(line.problem, "")
                self.lose(reactor)
                self.assertIn("closes each new connection", line.problem)
                (call,) = reactor.getDelayedCalls()
                found.append(round(call.getTime() - reactor.seconds(), 6))
                reactor.advance(found[-1] + 1e-5)
            self.assertEqual(found, wanted)
            factory.buildProtocol(None)
            reactor.advance(3.0)
            self.lose(reactor)
            self.assertEqual(line.problem, "")
            (call,) = reactor.getDelayedCalls()
            self.assertAlmostEqual(call.getTime() - reactor.seconds(), wanted[0])
            line.disconnect()
            factory.buildProtocol(None).dataReceived(b"x")
            self.lose(reactor)
            self.assertEqual(reactor.getDelayedCalls(), [])

    def test_says_once_what_keeps_a_link_from_being_opened(self) -> None:
        """An unreachable robot is logged once after several attempts, if ``says`` is set."""
        collector = WarningCollector()
        self.addCleanup(collector.close)
        for says in (False, True):
            reactor: Any = MemoryReactorClock()
            line = TcpConnector(reactor, says=says).connect("dog1", 9090, _Client())
            for _ in range(4):
                self.refuse(reactor)
            self.assertEqual(collector.warnings, [])
            for _ in range(50):
                self.refuse(reactor)
            self.assertEqual(len(collector.warnings), int(says))
            line.disconnect()
        self.assertIn("dog1:9090: nothing listens at this port", collector.warnings[0])

    def lose(self, reactor: Any) -> None:
        reactor.tcpClients[0][2].clientConnectionLost(_Retried(), Failure(ConnectionDone()))

    def refuse(self, reactor: Any) -> None:
        reactor.tcpClients[0][2].clientConnectionFailed(_Retried(), Failure(ConnectionRefusedError()))


class _Dead:
    """A link over a failed network; sent data never arrives."""

    is_busy = False

    def __init__(self) -> None:
        self.hung_up: Deferred[None] = Deferred()

    def connect(self, host: str, port: int, client: Port) -> _Dead:
        client.link_up(self)
        return self

    def send(self, data: bytes) -> None:
        """Drop the data."""

    def disconnect(self) -> Deferred[None]:
        """Return a Deferred that fires when all data is sent."""
        return self.hung_up

    def close(self) -> None:
        self.hung_up.callback(None)


class PortTests(SynchronousTestCase):
    """The connection to one port of a dog."""

    def test_leaves_a_dead_link_after_a_second(self) -> None:
        """``close`` waits for sent data, for at most a second."""
        clock = Clock()
        port = Port(_Dead(), clock, ("dog1", 10050), lambda: None, lambda: None, lambda _: None)  # type: ignore[arg-type]
        port.open()
        self.assertTrue(port.is_up)
        closed = port.close()
        clock.advance(0.9)
        self.assertNoResult(closed)
        clock.advance(0.2)
        self.successResultOf(closed)
        self.successResultOf(port.close())


class _Retried:
    """A connector for repeated attempts."""

    state = "disconnected"

    def connect(self) -> None:
        """Do nothing."""

    def stopConnecting(self) -> None:  # noqa: N802 (Twisted's)
        """Do nothing."""
