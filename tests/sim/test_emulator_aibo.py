"""Tests of ``sim.robots.emulator.aibo_dog`` with a client that sends and receives raw bytes."""

from __future__ import annotations

import math
import random
import struct
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.error import CannotListenError
from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from drivers.aibo.codec import T2, encode_command
from drivers.link import Link
from sim.robots.emulator.aibo import RETRY_S, AiboServer
from sim.robots.emulator.aibo_dog import AiboEmulator
from sim.robots.emulator.simulated_robot import MemoryRobot
from tests.drivers.contract import KeptLink

MAIN, STATE, WALK, HEAD, ESTOP, CAMERA, GAINS = 10020, 10031, 10050, 10052, 10053, 10011, 10032


class Client:
    """A client of one port that stores the received bytes."""

    def __init__(self) -> None:
        self.heard = b""
        self.link: Link | None = None

    def link_up(self, link: Link) -> None:
        self.link = link

    def link_down(self) -> None:
        self.link = None

    def data_received(self, data: bytes) -> None:
        self.heard += data


class AiboEmulatorTests(SynchronousTestCase):
    """The emulator follows the known protocol of an Aibo."""

    def setUp(self) -> None:
        """Create an emulated Aibo that was just switched on."""
        self.clock = Clock()
        self.body = MemoryRobot()
        self.dog = self.made()

    def made(self, dialect: str = "T4") -> AiboEmulator:
        dog = AiboEmulator(self.clock, self.body, random.Random(1), dialect)
        dog.start()
        self.addCleanup(dog.stop)
        self.connector = dog.connector()
        return dog

    def called(self, port: int) -> Client:
        """Return a client of the port; it is connected if the port listens."""
        client = Client()
        line = self.connector.connect("dog", port, client)
        self.addCleanup(line.disconnect)
        self.pass_time(0.01)
        return client

    def pass_time(self, seconds: float) -> None:
        self.clock.pump([0.002] * round(seconds / 0.002))

    def say(self, client: Client, data: bytes) -> bytes:
        """Send bytes and return the bytes that arrive within 10 ms."""
        assert client.link is not None
        client.heard = b""
        client.link.send(data)
        self.pass_time(0.01)
        return client.heard

    def released(self) -> tuple[Client, Client]:
        """Return clients of the main control and the walk server of a dog with enabled motors."""
        main, estop = self.called(MAIN), self.called(ESTOP)
        self.say(main, b'!select "Walk Remote Control"\n')
        self.say(estop, b"start\n")
        return main, self.called(WALK)

    def test_listens_where_a_dog_does(self) -> None:
        """Main control and e-stop listen from the start, other servers when they are selected.

        Each serves one client.
        """
        self.assertIsNone(self.called(WALK).link)
        main = self.called(MAIN)
        self.assertIsNotNone(self.called(ESTOP).link)
        self.assertIsNone(self.called(MAIN).link)
        heard = self.say(main, b'!select "Walk Remote Control"\n')
        self.assertTrue(heard.startswith(b"push\nload\norg.tekkotsu.mon.WalkGUI\nWalkGUI\n10050\n\npop\nrefresh\n"))
        walk = self.called(WALK)
        self.assertIsNotNone(walk.link)
        self.assertIsNone(self.called(WALK).link)
        assert walk.link is not None
        walk.link.close()
        self.pass_time(0.01)
        self.assertTrue(self.dog.is_listening(WALK))

    def test_shows_in_the_menu_what_runs(self) -> None:
        """A running server is listed as #name. Selecting name again has no effect; selecting #name stops the server."""
        main = self.called(MAIN)
        self.say(main, b'!select "Walk Remote Control"\n')
        again = self.say(main, b'!select "Walk Remote Control"\n')
        self.assertTrue(again.startswith(b"refresh\n"))
        self.assertIn(b"\n#Walk Remote Control\n", again)
        self.assertTrue(self.say(main, b'!select "#Walk Remote Control"\n').startswith(b"close\nWalkGUI\nrefresh\n"))
        self.assertFalse(self.dog.is_listening(WALK))

    def test_answers_every_line(self) -> None:
        """The reply to a known command is its result; the reply to an invalid line is a status."""
        main = self.called(MAIN)
        self.assertEqual(self.say(main, b"!hello\r\n"), b"hello\n1\n")
        self.assertEqual(self.say(main, b"!dump_stack\n"), b"stack_dump\n1\nRoot Control\n")
        self.assertTrue(self.say(main, b'!select "never closed\n').startswith(b"status\n0\n"))
        self.assertTrue(self.say(main, b"warp\n").startswith(b"status\n1\n"))
        self.assertIn(b"\n----------\n0\n\n2\n1\nMode Switch\n2\n", self.say(main, b"!refresh\n"))

    def test_starts_stopped_and_tells_changes_alone(self) -> None:
        """The e-stop is on at first, and sends nothing to a new client.

        It reports its state after the command ``refresh``, after a change and after a press of the button.
        """
        estop = self.called(ESTOP)
        self.assertEqual(estop.heard, b"")
        for said, answer in ((b"refresh\n", b"on\n"), (b"stop\n", b""), (b"start\n", b"off\n"), (b"warp\n", b"")):
            self.assertEqual(self.say(estop, said), answer)
        self.dog.press_back_button()
        self.pass_time(0.01)
        self.assertEqual(estop.heard, b"on\n")

    def test_walks_while_its_motors_are_on(self) -> None:
        """Each motion component stays in force until a command changes it.

        A stopped dog ignores commands, and stands still when its motors are enabled again.
        """
        _, walk = self.released()
        self.say(walk, encode_command("f", 0.5) + encode_command("r", -0.25))
        self.assertEqual(self.body.motion, (0.08, 0.0, -0.5075))
        self.say(walk, encode_command("f", -1.0) + encode_command("s", 1.0))
        self.assertEqual(self.body.motion, (-0.156, 0.103, -0.5075))
        self.dog.press_back_button()
        self.assertEqual(self.body.motion, (0.0, 0.0, 0.0))
        self.say(walk, encode_command("f", 0.5))
        self.dog.press_back_button()
        self.assertEqual(self.body.motion, (0.0, 0.0, 0.0))

    def test_walks_no_nan(self) -> None:
        """A motion component that is not finite counts as zero; the other components are used."""
        _, walk = self.released()
        for value in (math.nan, math.inf, -math.inf):
            self.say(walk, encode_command("f", 0.5) + encode_command("r", value))
            self.assertEqual(self.body.motion, (0.08, 0.0, 0.0))

    def test_stops_three_seconds_after_the_last_command(self) -> None:
        """The walk stops 3 s after the last command, even if that command had no effect."""
        _, walk = self.released()
        self.say(walk, encode_command("f", 0.5))
        self.pass_time(2.5)
        self.say(walk, encode_command("0", 0.0))
        self.pass_time(2.5)
        self.assertGreater(self.body.motion[0], 0.0)
        self.pass_time(0.6)
        self.assertEqual(self.body.motion, (0.0, 0.0, 0.0))

    def test_stops_when_its_walk_server_stops(self) -> None:
        """Stopping the walk server ends the walk and closes the server's connection."""
        main, walk = self.released()
        self.say(walk, encode_command("f", 0.5))
        self.say(main, b'!select "#Walk Remote Control"\n')
        self.assertEqual((self.body.motion, walk.link), ((0.0, 0.0, 0.0), None))

    def test_tells_its_world_every_32_ms(self) -> None:
        """World states of 374 bytes (244 in the older dialect) arrive every 32 ms, together with gains of 224 bytes."""
        for dialect, size in (("T4", 374), (T2, 244)):
            self.dog = self.made(dialect)
            main = self.called(MAIN)
            self.say(main, b'!select "World State Serializer"\n')
            state, gains = self.called(STATE), self.called(GAINS)
            state.heard = gains.heard = b""
            self.pass_time(3.2)
            self.assertEqual(len(state.heard) % size, 0)
            self.assertAlmostEqual(len(state.heard) / size, 100, delta=1.5, places=None)
            self.assertEqual(len(gains.heard), 224 * (len(state.heard) // size))

    def test_holds_its_head(self) -> None:
        """Head commands move the neck to the requested share of its range, and are clamped."""
        main = self.called(MAIN)
        self.say(main, b'!select "Head Remote Control"\n!select "World State Serializer"\n')
        head, state = self.called(HEAD), self.called(STATE)
        self.say(head, encode_command("p", 0.5) + encode_command("t", -9.0) + encode_command("x", 1.0))
        state.heard = b""
        self.pass_time(0.032)
        tilt, pan = struct.unpack_from("<2f", state.heard, 18 + 12 * 4)
        self.assertAlmostEqual(tilt, -1.309, places=5)
        self.assertAlmostEqual(pan, 0.768, places=5)

    def test_sends_pictures_only_where_they_are_asked_for(self) -> None:
        """Pictures are sent over TCP if this is configured, and over UDP after a request.

        The command ``CloseConnection`` ends them.
        """
        main = self.called(MAIN)
        heard = self.say(main, b'!select "Raw Cam Server"\n')
        self.assertIn(b'10011\n"raw" "10011" "udp"\n', heard)
        self.assertFalse(self.dog.is_listening(CAMERA))
        packets: list[bytes] = []
        self.dog.on_datagram(b"hello", packets.append)
        self.pass_time(0.1)
        self.assertEqual(packets, [])
        self.dog.on_datagram(b"connection request", packets.append)
        self.pass_time(1.0)
        self.assertIn(len(packets), (29, 30, 31))
        self.say(main, b'!select "#Raw Cam Server"\n')
        self.assertEqual(packets[-1], b"\x0f\0\0\0CloseConnection\0")
        self.say(main, b'!set vision.rawcam.transport=TCP\n!select "Raw Cam Server"\n')
        camera = self.called(CAMERA)
        self.pass_time(0.1)
        self.assertTrue(camera.heard.startswith(b"\x0d\0\0\0TekkotsuImage\0"))
        self.say(main, b'!select "#Raw Cam Server"\n')
        self.assertTrue(camera.heard.endswith(b"\x0f\0\0\0CloseConnection\0"))
        self.assertIsNone(camera.link)

    def test_begins_anew_after_a_reboot(self) -> None:
        """A reboot closes all links, stops servers and motors, and allows new connections."""
        main, walk = self.released()
        self.say(walk, encode_command("f", 0.5))
        self.dog.reboot()
        self.assertTrue(self.dog.is_engaged)
        self.assertEqual(self.body.motion, (0.0, 0.0, 0.0))
        self.assertFalse(self.dog.is_listening(WALK))
        self.pass_time(0.2)
        self.assertIsNotNone(main.link)
        self.assertIsNone(walk.link)


class Ports(Clock):
    """A reactor that, like a real one, closes sockets in its next turn; until then their ports are in use."""

    def __init__(self) -> None:
        super().__init__()
        self.taken: dict[int, Any] = {}

    def listenUDP(self, *_: object) -> Any:  # noqa: N802 (Twisted's)
        """Return a port object with number 0."""
        return _Port(self, 0)

    def listenTCP(self, port: int, factory: Any, interface: str) -> Any:  # noqa: N802 (Twisted's)
        """Open the port, or raise ``CannotListenError`` if it is in use."""
        if port in self.taken:
            raise CannotListenError(interface, port, OSError("in use"))
        self.taken[port] = factory
        return _Port(self, port)


class _Port:
    def __init__(self, reactor: Ports, number: int) -> None:
        self._reactor = reactor
        self._number = number

    def stopListening(self) -> Deferred[None]:  # noqa: N802 (Twisted's)
        """Free the port in the reactor's next turn."""
        closed: Deferred[None] = Deferred()
        self._reactor.callLater(0.0, self._reactor.taken.pop, self._number, None)
        self._reactor.callLater(0.0, closed.callback, None)
        return closed


class AiboServerTests(SynchronousTestCase):
    """An emulated dog opens and closes its ports as clients connect and leave."""

    def setUp(self) -> None:
        self.reactor = Ports()
        self.dog = AiboEmulator(self.reactor, MemoryRobot(), random.Random(1))
        self.server = AiboServer(self.reactor, self.dog)
        self.server.start()

    def tearDown(self) -> None:
        """After ``stop`` every port is free and no timer is left."""
        stopped = self.server.stop()
        self.reactor.advance(0.0)
        self.successResultOf(stopped)
        self.assertEqual((self.reactor.taken, self.reactor.getDelayedCalls()), ({}, []))

    def test_opens_a_port_again_once_its_socket_is_closed(self) -> None:
        """A port reopens after its socket has closed, even if the client left before the socket was closed."""
        gone = self.dog.accept(ESTOP, KeptLink())
        gone.link_down()
        main = self.dog.accept(MAIN, KeptLink())
        self.reactor.advance(0.0)
        self.assertEqual(set(self.reactor.taken), {ESTOP})
        main.link_down()
        self.assertEqual(set(self.reactor.taken), {ESTOP, MAIN})

    def test_tries_a_port_again_that_another_program_took(self) -> None:
        """A port that another program is using is retried, without an exception, until it is free."""
        client = self.dog.accept(ESTOP, KeptLink())
        self.reactor.advance(0.0)
        self.reactor.taken[ESTOP] = "another"
        client.link_down()
        self.reactor.advance(RETRY_S)
        self.assertEqual(self.reactor.taken[ESTOP], "another")
        del self.reactor.taken[ESTOP]
        self.reactor.advance(RETRY_S)
        self.assertIn(ESTOP, self.reactor.taken)
