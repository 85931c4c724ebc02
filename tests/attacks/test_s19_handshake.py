"""Attack S19: make a node reply, act or store state by a recorded handshake that contains a request."""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import Any

from twisted.internet.defer import Deferred

from middleware.admission.roles import METHODS
from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity, derive_exchange_key
from middleware.entangled.network.network import Address
from middleware.entangled.record import hash_key
from middleware.entangled.streams import PART_BYTES, Streams
from middleware.entangled.wire import peer
from middleware.entangled.wire.admission_check import MAX_IDENTITIES, Incarnation, InitTimestamps
from middleware.entangled.wire.endpoint import Endpoint
from middleware.entangled.wire.message import Request, encode
from middleware.entangled.wire.session import INIT, RESPONSES_S, Credentials, HandshakeFields, InitiatorHandshake
from tests.attacks.siege import SiegeCase
from tests.fuzz.ground import state_of
from tests.middleware.admission.village import House, Tape, Village, network_of
from tests.middleware.test_endpoint import DELAY, EndpointCase

VICTIM = Address("10.7.7.7", 77)
KEY = hash_key("tasks")
LARGE = b"x" * 4000
ARGUMENTS: dict[str, tuple[object, ...]] = {
    "ping": (bytes(8),),
    "find_node": (bytes(20),),
    "members": (b"",),
    "store": ([],),
    "find_value": (KEY,),
    "cache": (KEY, [], 60.0),
    "watch": (KEY, bytes(8)),
    "push": (KEY, 1, [], []),
    "alive": (1.0, bytes(8)),
    "missing": ([],),
    "let_go": ([],),
    "digests": (0, 2),
    "places": (0, []),
    "lacking": ([],),
    "fetch": ([],),
    "decree.claim": (KEY, [], bytes(8), 1, bytes(20), 1.0),
    "decree.confirm": (KEY, [], bytes(8), 1, bytes(20), bytes(20)),
    "decree.release": (KEY, [], bytes(8), 1, bytes(20)),
    "roll.tell": ([],),
    "roll.compare": (bytes(16),),
    "roll.fetch": ([],),
    "roll.secret": (1,),
    "reach.introduce": (bytes(20), [], 0),
    "reach.meet": (Identity(b"v" * 32).public, [], 0),
    "reach.seen": (VICTIM.host, VICTIM.port),
    "stream.open": ("camera",),
    "stream.part": ("camera", 1, 0, 1, b"x", 0),
}
"""Arguments with which the methods of a node are called; methods that are missing here are called without arguments."""


class RecordedQuestionTests(SiegeCase):
    """A node of a closed team with a camera and all methods, which has no sessions after a restart."""

    def setUp(self) -> None:
        """Count the bytes that the node sends to each address, and record the methods that run without a session."""
        super().setUp()
        self.team: Village = self.village()
        for name in ("cat", "pig", "cow", "hen", "fox", "owl"):
            self.team.enlist(name, "device", "operator", "gateway")
        self.house = self.team.houses[0]
        self.member = self.team.paper("dog", "device", "operator", "gateway")
        self.sent: Counter[Address] = Counter()
        self.ran: list[str] = []
        self.numbers = 0
        self.restart()

    def restart(self) -> None:
        """Restart the node, which deletes its handshakes and sessions."""
        self.team.close(self.house, is_sudden=True)
        self.team.open(self.house)
        network, endpoint = network_of(self.house), self.house.node.endpoint
        _ = self.house.node.take_acceptor
        self.streams = Streams(endpoint, self.team.clock)

        def answer(name: str, *arguments: object) -> bytes:
            self.ran.append(name)
            return LARGE

        for name in METHODS:
            if name not in endpoint._dispatcher.methods:
                endpoint.expose(name, partial(answer, name))
        send = network.send

        def count(datagram: bytes, to: Address) -> None:
            self.sent[to] += len(datagram)
            if to != VICTIM:  # no node has this address, so a datagram in transit would stay in the state
                send(datagram, to)

        port: Any = network
        port.send = count
        for method in endpoint._dispatcher.methods.values():
            _ = method._signature  # otherwise the value would be determined at the first call
        self.team.run(20.0)

    def recording(self, method: str) -> bytes:
        """Return a member's recorded INIT, which contains a request."""
        self.numbers += 1
        request = encode(Request(self.numbers, method, ARGUMENTS.get(method, ())))
        own = Credentials.derive(self.member.identity, self.house.team.secret)
        hello = HandshakeFields(Incarnation(1, b"the life"), self.member.certificate, 640)
        secret = self.numbers.to_bytes(32, "little")
        remote = derive_exchange_key(self.house.public)
        return InitiatorHandshake(own, remote, secret, self.numbers, request, hello, self.numbers).make_init()

    def state(self) -> str:
        """Return the hash of the node's state without half-open sessions, which are limited and expire soon."""
        endpoint = self.house.node.endpoint
        half = endpoint._half_open
        for session in list(half._unconfirmed.values()):
            half.forget(session)
        half.clear()
        timestamps, endpoint._timestamps = endpoint._timestamps, InitTimestamps()
        timers = sorted(call.getTime() for call in self.team.clock.getDelayedCalls())
        found = state_of(
            [self.house.node, self.house.node.store, self.house.team.membership_list, self.streams, timers]
        )
        endpoint._timestamps = timestamps
        return found

    def play(self, datagram: bytes) -> None:
        """Send a recording to the node, with the address of a victim as its source."""
        receiver = network_of(self.house).receiver
        assert receiver is not None
        receiver(datagram, VICTIM)

    def show(self, seconds: float) -> None:
        """Let time pass while the camera provides ten pictures per second."""
        for number in range(int(10 * seconds)):
            self.streams.publish("camera", number, bytes(20 * PART_BYTES))
            self.team.run(0.1)

    def test_every_method(self) -> None:
        """For any method, a recorded INIT with a request changes nothing, and its reply is not longer than the INIT."""
        methods = self.house.node.endpoint._dispatcher.methods
        self.assertLessEqual(set(METHODS), set(methods))
        answered = []
        for name in methods:
            recording = self.recording(name)
            before = self.state()
            self.sent.clear()
            self.play(recording)
            answered += [name] * bool(self.sent[VICTIM])
            changed = [name] * (self.state() != before)
            self.show(3.0)
            self.assertLessEqual(self.sent[VICTIM], len(recording), name)
            self.assertEqual(changed, [])
        self.assertEqual(answered, list(methods))  # the node accepted each INIT and sent a RESP
        self.assertEqual(self.ran, [])

    def test_pictures_for_a_victim(self) -> None:
        """A recorded INIT that requests pictures, replayed after a restart, causes no picture to a spoofed address."""
        recording = self.recording("stream.open")
        for _ in range(5):
            self.sent.clear()
            self.play(recording)
            self.show(5.0)
            self.assertLessEqual(self.sent[VICTIM], len(recording))
            self.restart()

    def test_a_member_gets_its_pictures(self) -> None:
        """A member that confirms its session gets the pictures that it requested."""
        viewer, _ = self.insider(self.team, "eye", "viewer")
        shown: list[int] = []
        watching = Streams(viewer, self.team.clock)
        stop = watching.view(self.team.contact(self.house), "camera", lambda number, frame, age: shown.append(number))
        self.show(3.0)
        stop()
        self.assertGreater(len(shown), 20)


class TimestampTests(SiegeCase):
    def setUp(self) -> None:
        super().setUp()
        self.team = self.village()
        self.house = self.team.houses[0]
        self.team.enlist("dog", "device")
        self.tape = Tape()
        self.tape.tap(network_of(self.house))

    def open_again(self, house: House) -> bytes:
        """Let a member open a further session with the first node; return the INIT of this member."""
        house.node.endpoint.reopen(self.team.contact(self.house))
        self.team.run(1.0)
        return [datagram for _, datagram, _ in self.tape.heard if datagram[0] == INIT][-1]

    def played(self, recording: bytes) -> tuple[int, int]:
        """Return the number of bytes that the node sends for a recording, and the number of sessions that it opens."""
        network: Any = network_of(self.house)
        endpoint = self.house.node.endpoint
        sent, sessions = [0], len(endpoint._sessions)
        send, network.send = network.send, lambda datagram, to: sent.append(len(datagram))
        network.receiver(recording, VICTIM)
        network.send = send
        return sum(sent), len(endpoint._sessions) - sessions

    def test_an_older_one_is_dropped(self) -> None:
        """Replayed INITs that are not newer than the member's last INIT are dropped without a reply.

        A newer INIT is answered.
        """
        dog = self.team.houses[1]
        recordings = [self.open_again(dog) for _ in range(3)]
        self.assertEqual(len(set(recordings)), 3)
        self.team.run(RESPONSES_S + 1.0)
        for recording in recordings:
            self.assertEqual(self.played(recording), (0, 0))
        self.assertEqual(self.house.node.endpoint.counters["replayed"], 3)
        self.open_again(dog)
        self.assertTrue(self.house.node.endpoint.has_session(self.team.contact(dog)))

    def test_one_of_an_earlier_life(self) -> None:
        """An INIT from before a restart of its sender opens no session, and the sender can still connect."""
        dog = self.team.houses[1]
        recording = self.open_again(dog)
        self.team.close(dog, is_sudden=True)
        self.team.open(dog)
        self.team.run(5.0)
        self.assertTrue(self.house.node.endpoint.has_session(self.team.contact(dog)))
        self.team.run(RESPONSES_S + 1.0)
        self.assertEqual(self.played(recording)[1], 0)
        self.open_again(dog)
        self.assertEqual(self.house.node.endpoint.counters["replayed"], 0)

    def test_bounded(self) -> None:
        """The table of newest INITs is limited.

        An unverified later incarnation does not block an earlier incarnation.
        """
        timestamps, first, later = InitTimestamps(), Incarnation(1, b"1" * 8), Incarnation(2, b"2" * 8)
        answers = [
            timestamps.accept(b"a", incarnation, timestamp)
            for incarnation, timestamp in ((first, 5), (first, 5), (first, 4), (first, 6))
        ]
        self.assertEqual(answers, [True, False, False, True])
        answers = [
            timestamps.accept(b"a", incarnation, timestamp)
            for incarnation, timestamp in ((later, 1), (first, 9), (later, 1), (later, 2))
        ]
        self.assertEqual(answers, [True, False, False, True])
        self.assertEqual(
            [timestamps.accept(b"b", Incarnation(), 5), timestamps.accept(b"b", first, 0), len(timestamps)],
            [True, True, 1],
        )
        for number in range(MAX_IDENTITIES + 5):
            timestamps.accept(number.to_bytes(4, "big"), first, 1)
        self.assertEqual(len(timestamps), MAX_IDENTITIES)


class RoundTripTests(EndpointCase):
    def asked(self, method: str, *arguments: object, changes: bool) -> float:
        """Return the number of round trips until the first request to a peer is answered."""
        identity = Identity(self.rng.randbytes(32))
        requester = Endpoint(identity, b"k" * 32, self.switchboard.make_network("127.0.0.1", 0), self.clock, self.rng)
        requester.start()
        self.addCleanup(requester.stop)
        answered: list[object] = []
        requester.ask(self.to_b, method, *arguments, changes=changes).addCallback(answered.append)
        trips = 0.0
        while not answered:
            self.clock.advance(DELAY)
            trips += 0.5
        return trips

    def test_one_more_for_changes_and_large_answers(self) -> None:
        """The first request to a peer takes one round trip for a read with a small answer, otherwise two."""
        self.b.expose("zeros", lambda peer, count: bytes(count), early=True)
        self.b.expose("late", lambda peer: 1)
        self.assertEqual(self.asked("echo", 1, changes=False), 1.0)
        self.assertEqual(self.asked("add", 1, changes=True), 2.0)
        self.assertEqual(self.asked("add", 2, changes=False), 2.0)
        self.assertEqual(self.asked("late", changes=False), 2.0)
        self.assertEqual(self.asked("zeros", 1000, changes=False), 2.0)

    def test_early_and_changing(self) -> None:
        """A method that changes state cannot be exposed as an early method, which may run before the session exists."""
        self.assertRaises(ValueError, self.b.expose, "bad", lambda peer: 1, changes=True, early=True)

    def test_early_and_slow(self) -> None:
        """If an early method, which may run before the session exists, has no immediate result, it is cancelled.

        The method runs again in the session.
        """
        cancelled: list[object] = []
        waiting: list[Deferred[int]] = []

        def slow(peer: Contact) -> Deferred[int]:
            waiting.append(Deferred(cancelled.append))
            return waiting[-1]

        self.b.expose("slow", slow, early=True)
        asked = self.a.ask(self.to_b, "slow")
        self.clock.advance(3 * DELAY)
        self.assertEqual((len(cancelled), len(waiting)), (1, 2))
        waiting[1].callback(5)
        self.assertEqual(self.got(asked), 5)


class KeyLifeTests(SiegeCase):
    def test_keys_are_replaced(self) -> None:
        """Sessions in use get new keys every two minutes, and no node has keys that are older than three minutes."""
        team = self.village()
        for name in ("dog", "cat"):
            team.enlist(name)
        seen: set[bytes] = set()
        for _ in range(60):
            team.run(10.0)
            for house in team.houses:
                for session in house.node.endpoint._sessions.values():
                    seen.add(bytes(session._sending))
                    self.assertLess(team.clock.seconds() - session.opened_at, peer.SESSION_END_S + 2.0)
        self.assertGreaterEqual(len(seen), 2 * 3 * 4)
