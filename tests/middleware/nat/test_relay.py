"""Tests of the relay (permitted pairs of peers, rates and limits) and of upgrades to direct paths."""

from __future__ import annotations

import random
from collections import Counter

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity
from middleware.entangled.nat.relay import (
    MAX_PAIRS,
    ONE_SIDED_S,
    PAIR_BURST,
    PAIR_RATE,
    RELAY_REQUEST,
    RELAYED_DATAGRAM,
    Relay,
)
from middleware.entangled.nat.upgrade import RETRY_INTERVALS_S, SILENCE_LIMIT_S, TURN_DELAY_S, PathUpgrades
from middleware.entangled.network.network import MAX_DATAGRAM_BYTES, MAX_RELAYED_BYTES, Address, relayed_address
from middleware.entangled.network.switchboard import Switchboard
from middleware.entangled.wire.noise import TransportKeys
from middleware.entangled.wire.peer import Peers
from middleware.entangled.wire.session import Session


class RelayTests(SynchronousTestCase):
    """Tests of ``Relay`` with artificial sessions."""

    def setUp(self) -> None:
        """Create a relay with three peers."""
        self.clock = HeapClock()
        self.counters: Counter[str] = Counter()
        self.sent: list[tuple[bytes, bytes]] = []
        self.sessions = {session.contact.node_id: session for session in map(self.session, range(3))}
        self.a, self.b, self.c = self.sessions
        self.relay = Relay(self.sessions.get, self.send, self.clock, self.counters)

    def session(self, number: int) -> Session:
        """Create a session with a peer."""
        public = Identity(number.to_bytes(32)).public
        keys = TransportKeys(bytes(32), bytes(32), bytes(32))
        return Session(Contact(public, Address("203.0.113.1", 1 + number)), number, number, keys, 0.0, True)

    def send(self, session: Session, plain: bytes) -> None:
        """Record a datagram that the relay sends, and check its size."""
        self.assertLessEqual(len(session.seal(plain)), MAX_RELAYED_BYTES)
        self.sent.append((session.contact.node_id, plain))

    def carry(self, sender: bytes, to: bytes, inner: bytes = b"inner") -> int:
        """Return the number of datagrams that the relay forwards for one datagram from ``sender``."""
        before = len(self.sent)
        self.relay.on_request(self.sessions[sender], bytes([RELAY_REQUEST]) + to + inner, Address("203.0.113.1", 1))
        return len(self.sent) - before

    def test_carries(self) -> None:
        """A forwarded datagram, up to the maximum size, contains the id of its sender."""
        self.assertEqual(self.carry(self.a, self.b, bytes(MAX_DATAGRAM_BYTES)), 1)
        self.assertEqual(self.sent, [(self.b, bytes([RELAYED_DATAGRAM]) + self.a + bytes(MAX_DATAGRAM_BYTES))])

    def test_what_is_not_carried(self) -> None:
        """Datagrams to unknown nodes, to the sender, of invalid length or from a relayed session are not forwarded."""
        self.assertEqual(self.carry(self.a, bytes(20)), 0)
        self.assertEqual(self.carry(self.a, self.a), 0)
        self.assertEqual(self.carry(self.a, self.b, b""), 0)
        self.assertEqual(self.carry(self.a, self.b, bytes(MAX_DATAGRAM_BYTES + 1)), 0)
        self.assertEqual(self.carry(self.a, self.b[:10], b""), 0)
        session = self.sessions[self.a]
        session.contact = Contact(session.contact.public, relayed_address(self.a))
        self.assertEqual(self.carry(self.a, self.b), 0)
        self.assertEqual(self.counters["uncarried"] + self.counters["malformed"], 6)

    def test_a_pair_has_its_share(self) -> None:
        """Each pair may send a burst and then data at a limited rate, independently of other pairs."""
        full = bytes(MAX_DATAGRAM_BYTES)
        self.assertEqual(sum(self.carry(self.a, self.b, full) for _ in range(200)), PAIR_BURST // MAX_DATAGRAM_BYTES)
        self.assertEqual(self.carry(self.b, self.a, full), 0)
        self.assertEqual(self.carry(self.a, self.c, full), 1)
        carried = 0
        for _ in range(1000):
            self.clock.advance(0.1)
            carried += len(full) * (self.carry(self.a, self.b, full) + self.carry(self.b, self.a, full))
        self.assertApproximates(carried / 100.0, PAIR_RATE, PAIR_RATE * 0.05)

    def test_one_sided_pairs_end(self) -> None:
        """A pair with traffic in one direction only is blocked after two minutes, until the other peer sends."""
        for _ in range(int(ONE_SIDED_S)):
            self.assertEqual(self.carry(self.a, self.b), 1)
            self.clock.advance(1.0)
        self.clock.advance(1.0)
        self.assertEqual(self.carry(self.a, self.b), 0)
        self.assertEqual(self.carry(self.b, self.a), 1)
        self.assertEqual(self.carry(self.a, self.b), 1)

    def test_pairs_are_bounded(self) -> None:
        """If the table of pairs is full, a new pair is rejected until another pair is idle."""
        many = [self.session(number) for number in range(3, 4 + MAX_PAIRS)]
        self.sessions.update({session.contact.node_id: session for session in many})
        carried = [self.carry(self.a, session.contact.node_id) for session in many]
        self.assertEqual((sum(carried), carried[-1], len(self.relay)), (MAX_PAIRS, 0, MAX_PAIRS))
        self.clock.advance(ONE_SIDED_S + 1.0)
        self.assertTrue(self.relay.has_room)
        self.assertEqual((self.carry(self.a, many[-1].contact.node_id), len(self.relay)), (1, 1))


class UpgradeTests(SynchronousTestCase):
    """Tests of ``PathUpgrades`` with one relayed peer."""

    def setUp(self) -> None:
        """Create a relayed session."""
        clock, rng = HeapClock(), random.Random(1)
        peers = Peers([], clock, rng, Switchboard(clock, rng).make_network("10.0.0.1", 7), Counter())
        identity = Identity(b"p" * 32)
        self.public = identity.public
        contact = Contact(identity.public, relayed_address(identity.node_id))
        self.session = Session(contact, 1, 2, TransportKeys(bytes(32), bytes(32), bytes(32)), 0.0, is_confirmed=True)
        peers.add_session(self.session)
        self.upgrades = PathUpgrades(peers)

    def tried(self, until: float) -> list[float]:
        """Return the times of upgrade attempts while the peer is heard every half second."""
        moments = []
        for step in range(int(2 * until) + 1):
            self.session.last_received_at = now = step / 2
            moments += [now for _ in self.upgrades.due(now)]
        return moments

    def test_more_and_more_rarely(self) -> None:
        """The pauses between attempts increase. After a change of the local address they are short again."""
        self.upgrades.add(self.public, False, 0.0)
        self.upgrades.add(self.public, False, 0.9)  # this address was already known
        moments = self.tried(150.0)
        pauses = [after - before for before, after in zip([0.0, *moments], moments, strict=False)]
        self.assertEqual(pauses, [*RETRY_INTERVALS_S, RETRY_INTERVALS_S[-1]])
        self.upgrades.retry_now(151.0)
        self.assertEqual([step for _, step in self.upgrades.due(151.0)], [0])

    def test_only_one_of_the_two(self) -> None:
        """The peer for which ``is_behind`` is true tries later, and waits longer if the other peer tries."""
        self.upgrades.add(self.public, True, 0.0)
        self.assertEqual(self.tried(RETRY_INTERVALS_S[0] + TURN_DELAY_S), [RETRY_INTERVALS_S[0] + TURN_DELAY_S])
        now = RETRY_INTERVALS_S[0] + 2 * TURN_DELAY_S
        self.upgrades.delay(self.public, now)
        self.assertEqual(self.tried(10.0)[0], now + RETRY_INTERVALS_S[1] + TURN_DELAY_S)

    def test_no_longer_than_needed(self) -> None:
        """A peer that is reached directly, or that is silent for long, is removed."""
        self.upgrades.add(self.public, False, 0.0)
        self.upgrades.drop(self.public)
        self.assertEqual(len(self.upgrades), 0)
        self.upgrades.add(self.public, False, 0.0)
        self.assertEqual(list(self.upgrades.due(self.session.last_received_at + SILENCE_LIMIT_S + 0.1)), [])
        self.assertEqual(len(self.upgrades), 0)
