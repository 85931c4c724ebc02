"""Tests of the messages of ``sim.robots.simulator`` and ``sim.robots.paced_simulator``."""

from __future__ import annotations

from random import Random
from typing import Any

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from drivers.sim.codec import (
    VERSION,
    CommandResult,
    Drive,
    FrameReader,
    Halt,
    Hello,
    KeepAlive,
    Message,
    Motors,
    Picture,
    Refused,
    Sensors,
    SubscribeWorld,
    WorldCommand,
    WorldSnapshot,
    encode_message,
)
from sim.robots.paced_simulator import SILENCE_LIMIT_S, PeriodicTimer, Session
from sim.robots.scene import load_scene
from sim.robots.simulator import RobotSimulator
from sim.robots.world import TICK_S


class Client:
    """A client of the simulator that stores the received messages."""

    def __init__(self, simulator: RobotSimulator) -> None:
        self.is_busy = False
        self.is_open = True
        self.heard: list[Message] = []
        self._reader = FrameReader()
        self.session: Session | None = None
        self.session = simulator.attach(self)

    def send(self, data: bytes) -> None:
        """Receive data from the simulator."""
        self.heard += self._reader.read(data)

    def close(self) -> None:
        """Record that the simulator closes the link."""
        if self.is_open:
            self.is_open = False
            if self.session is not None:
                self.session.link_down()

    def say(self, *messages: Message) -> None:
        """Send messages to the simulator."""
        assert self.session is not None
        self.session.data_received(b"".join(encode_message(message) for message in messages))

    def of(self, kind: type[Message]) -> list[Message]:
        """Return the received messages of one type."""
        return [message for message in self.heard if isinstance(message, kind)]


class SimulatorTests(SynchronousTestCase):
    """The simulator serves its clients."""

    def setUp(self) -> None:
        """Start a simulator in virtual time, with a driver for dog1."""
        self.clock = Clock()
        self.simulator = RobotSimulator(self.clock, Random(1), load_scene("three-dogs"))
        self.simulator.start()
        self.client = Client(self.simulator)
        self.client.say(Hello(VERSION, "dog1", 0.0), Motors(True))

    def ticks(self, count: int) -> None:
        """Advance by whole ticks."""
        for _ in range(count):
            self.clock.advance(TICK_S)

    def drive(self, token: int = 1, ttl: float = 0.5, sent: float | None = None, vx: float = 0.16) -> None:
        """Send a command as dog1's driver."""
        self.client.say(Drive(vx, 0.0, 0.0, token, ttl, self.clock.seconds() if sent is None else sent))

    def is_moving(self) -> bool:
        """Return whether dog1 moves."""
        return self.simulator.world.dogs["dog1"].is_moving

    def test_sends_a_sensor_frame_each_32_ms(self) -> None:
        """After ten seconds 312 frames have arrived; their timestamps are exactly 32 ms apart."""
        for _ in range(1000):
            self.clock.advance(0.01)
            self.client.say(KeepAlive())
        stamps = [message.t for message in self.client.of(Sensors) if isinstance(message, Sensors)]
        self.assertEqual(len(stamps), 312)
        self.assertAlmostEqual(stamps[-1], 312 * TICK_S, 9)

    def test_catches_up_on_physics_but_not_on_pictures(self) -> None:
        """After a delay of half a second all missed sensor frames are sent, but only one picture."""
        self.client.say(Hello(VERSION, "dog1", 30.0))
        self.ticks(2)
        before = len(self.client.of(Picture))
        self.clock.advance(0.512)
        self.assertEqual(len(self.client.of(Sensors)), 18)
        self.assertEqual(len(self.client.of(Picture)), before + 1)

    def test_draws_only_for_those_who_asked(self) -> None:
        """A client gets no pictures by default, ten per second if it requests ten, and never more than thirty."""
        self.ticks(31)
        self.assertEqual(self.client.of(Picture), [])
        for wish, count in ((10.0, 10), (99.0, 30)):
            before = len(self.client.of(Picture))
            self.client.say(Hello(VERSION, "dog1", wish))
            self.ticks(31)
            self.assertIn(len(self.client.of(Picture)) - before, (count - 1, count, count + 1))

    def test_stops_at_the_end_of_the_time_to_live(self) -> None:
        """A command ends when its TTL, counted from its timestamp, has passed.

        A future timestamp does not extend it.
        """
        self.ticks(40)
        self.drive(ttl=0.3)
        self.ticks(8)
        self.assertTrue(self.is_moving())
        self.ticks(4)
        self.assertFalse(self.is_moving())
        now = self.clock.seconds()
        self.drive(ttl=0.5, sent=now - 0.6)
        self.ticks(1)
        self.assertFalse(self.is_moving())
        self.drive(ttl=0.5, sent=now - 0.4)
        self.ticks(2)
        self.assertTrue(self.is_moving())
        self.ticks(4)
        self.assertFalse(self.is_moving())
        self.drive(ttl=0.2, sent=now + 1000.0)
        self.ticks(9)
        self.assertFalse(self.is_moving())

    def test_halts_at_once(self) -> None:
        """A halt needs no token; a dog with disabled motors does not move."""
        for stop in (Halt(), Motors(False)):
            self.drive(ttl=5.0)
            self.ticks(5)
            self.assertTrue(self.is_moving())
            self.client.say(stop)
            self.ticks(4)
            self.assertFalse(self.is_moving())
        self.drive(ttl=5.0)
        self.ticks(5)
        self.assertFalse(self.is_moving())

    def test_stops_the_dog_of_a_lost_driver(self) -> None:
        """If the connection closes, the dog stops; a new driver can connect, and receives the last token of the dog."""
        self.drive(token=9, ttl=5.0)
        self.ticks(5)
        self.client.close()
        self.ticks(4)
        self.assertFalse(self.is_moving())
        self.client = Client(self.simulator)
        self.client.say(Hello(VERSION, "dog1", 0.0), Motors(True))
        self.ticks(1)
        self.assertEqual([m.token for m in self.client.of(Sensors) if isinstance(m, Sensors)], [9])
        self.drive(token=8, ttl=5.0)
        self.ticks(5)
        self.assertFalse(self.is_moving())
        self.drive(token=9, ttl=5.0)
        self.ticks(5)
        self.assertTrue(self.is_moving())

    def test_forgets_a_suspension(self) -> None:
        """After a suspension the simulation continues from its last state, and earlier commands have expired."""
        self.drive(ttl=5.0)
        self.ticks(5)
        self.clock.advance(60.0)
        self.ticks(5)
        self.assertFalse(self.is_moving())
        self.assertLess(self.simulator.world.t, 2.0)

    def test_tells_what_the_gates_did(self) -> None:
        """Expired commands and commands with a lower token are rejected.

        Both accepted and rejected commands are counted, for each dog.
        """
        self.drive(token=7)
        self.drive(token=7)
        self.drive(token=6, vx=-0.1)
        self.drive(token=8, ttl=0.0)
        self.ticks(10)
        self.assertGreater(self.simulator.world.dogs["dog1"].motion.vx, 0.1)
        dogs: Any = self.simulator.get_true_state()["dogs"]
        told = [(dog["name"], dog["token"], dog["accepted"], dog["refused"]) for dog in dogs]
        self.assertEqual(told, [("dog1", 7, 2, 2), ("dog2", 0, 0, 0), ("dog3", 0, 0, 0)])

    def test_gives_up_a_silent_client(self) -> None:
        """A driver that falls silent and a client that never sends hello are disconnected after ``SILENCE_LIMIT_S``."""
        stranger = Client(self.simulator)
        lively = Client(self.simulator)
        for _ in range(round(SILENCE_LIMIT_S / TICK_S) + 3):
            lively.say(KeepAlive())
            self.ticks(1)
        self.assertEqual((self.client.is_open, stranger.is_open, lively.is_open), (False, False, True))
        self.assertEqual(self.simulator.driven_robots, [])

    def test_refuses_drivers(self) -> None:
        """A robot with a driver is refused temporarily; an unknown robot, version or second robot permanently."""
        cases = [("dog1", VERSION, False), ("cat", VERSION, True), ("dog2", VERSION + 1, True)]
        for robot, version, is_lasting in cases:
            client = Client(self.simulator)
            client.say(Hello(version, robot, 0.0))
            (refusal,) = client.heard
            assert isinstance(refusal, Refused)
            self.assertEqual((refusal.lasting, client.is_open), (is_lasting, False))
        self.assertEqual(self.simulator.driven_robots, ["dog1"])
        self.client.say(Hello(VERSION, "dog2", 0.0))
        self.assertEqual(self.client.heard[-1], Refused("this connection already uses dog1", True))
        self.assertEqual(self.simulator.driven_robots, [])

    def test_drops_for_a_client_that_does_not_read(self) -> None:
        """A busy client gets nothing until it can receive again; then it gets the newest frame."""
        self.client.is_busy = True
        self.ticks(10)
        self.assertEqual(self.client.heard, [])
        self.client.is_busy = False
        self.ticks(1)
        (newest,) = self.client.of(Sensors)
        assert isinstance(newest, Sensors)
        self.assertAlmostEqual(newest.t, 11 * TICK_S)
        self.assertEqual({len(row) for row in newest.samples.values()}, {4})

    def test_lives_on_after_rubbish(self) -> None:
        """Invalid bytes, requests without the operator's rights, and commands without a dog have no effect."""
        before = self.simulator.world.snapshot()
        stranger = Client(self.simulator)
        assert stranger.session is not None
        stranger.session.data_received(b"\x00\xff" * 500)
        stranger.say(WorldCommand(1, "scatter", (1,)), Drive(0.1, 0.0, 0.0, 1, 1.0, 0.0), Halt())
        self.assertEqual((stranger.heard, self.simulator.world.snapshot()), ([], before))

    def test_shows_the_operator_everything(self) -> None:
        """An operator receives the true state at the requested rate, and a reply to every request, valid or invalid."""
        operator = Client(self.simulator)
        operator.say(SubscribeWorld(VERSION, 5.0))
        self.ticks(31)
        self.assertIn(len(operator.of(WorldSnapshot)), (5, 6))
        operator.say(
            WorldCommand(1, "place_target", (2.0, 2.0)),
            WorldCommand(2, "place_target", (2.0,)),
            WorldCommand(3, "place_target", (2, 2)),
            WorldCommand(4, "explode", ()),
            WorldCommand(5, "place_target", (float(9), 2.0)),
        )
        done = [message for message in operator.heard if isinstance(message, CommandResult)]
        self.assertEqual([(one.number, bool(one.problem)) for one in done], [(n, n > 1) for n in range(1, 6)])
        self.assertIsNotNone(self.simulator.world.target)

    def test_turns_away_the_crowd(self) -> None:
        """The sixty-fifth connection is rejected; ``stop`` closes all connections, and no timer remains."""
        crowd = [Client(self.simulator) for _ in range(65)]
        self.assertEqual(sum(not client.is_open for client in crowd), 2)
        self.assertTrue(self.client.is_open)
        self.simulator.stop()
        self.assertFalse(self.client.is_open)
        self.assertEqual(self.clock.getDelayedCalls(), [])


class PeriodicTimerTests(SynchronousTestCase):
    """``PeriodicTimer`` schedules pictures."""

    def test_keeps_its_rate_on_average(self) -> None:
        """The timer keeps any rate up to the tick rate; after a pause one picture is due, not all missed pictures."""
        for rate in (0.0, 1.0, 10.0, 15.0, 29.97, 30.0, 31.25):
            beat = PeriodicTimer(rate)
            count = sum(beat.is_due(tick * TICK_S) for tick in range(1, 3126))
            self.assertLess(abs(count - 100 * rate), 2, rate)
        beat = PeriodicTimer(10.0)
        self.assertTrue(beat.is_due(0.0))
        self.assertEqual([beat.is_due(50.0), beat.is_due(50.032), beat.is_due(50.064)], [True, False, False])
