"""Attack S3: send datagrams with spoofed addresses, and unsolicited, guessed or misdirected answers."""

from __future__ import annotations

import random
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.contact import Contact
from middleware.entangled.errors import NoAnswer
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.wire.discovery import DISCOVERY, DISCOVERY_REPLY, pack_discovery, pack_discovery_reply
from middleware.entangled.wire.message import Answer, Failure, Request, encode
from middleware.entangled.wire.probe import PROBE, PROBE_REPLY
from middleware.entangled.wire.session import DATA, INIT, RESP, derive_key
from tests.fuzz.ground import STRANGER, TEAM, Ground

SEQUENCES = settings(max_examples=40, stateful_step_count=25)
KINDS = (INIT, RESP, DATA, DISCOVERY, DISCOVERY_REPLY, 0x16, 0x17, 0x18, PROBE, PROBE_REPLY, 0x03, 0x00, 0xFF)
PLACES = (STRANGER, Address("10.0.0.2", 2), Address("10.0.0.1", 1), Address("::1", 9), Address("~" + "0" * 40, 1))


def member(ground: Ground) -> Contact:
    """Return the member that has a session with the target."""
    return Contact(ground.identity.public, ground.other.address)


def sealed(ground: Ground, plain: bytes) -> bytes:
    return next(iter(ground.other._sessions.values())).seal(plain)


class Spoofing(RuleBasedStateMachine):
    """A node with a session, and an attacker that can spoof any source address but has no key."""

    @initialize(seed=st.integers(0, 99))
    def begin(self, seed: int) -> None:
        """Start a node with a session and a pending request that gets no answer."""
        self.ground = Ground()
        self.dice = random.Random(seed)
        self.answers: list[Any] = []
        silent = Contact(Identity(b"s" * 32).public, Address("10.0.0.7", 7))
        self.ground.target.ask(silent, "echo", 1).addBoth(self.answers.append)
        self.ground.target.ask(member(self.ground), "ping", changes=True).addBoth(self.answers.append)
        self.before = self.ground.state()

    def teardown(self) -> None:
        if hasattr(self, "ground"):
            self.ground.stop()

    def fire(self, datagram: bytes, source: Address) -> None:
        """Deliver one datagram; the reply must not be larger than the datagram."""
        if self.ground.shoot(datagram, source) > len(datagram):
            raise AssertionError("more was sent than had come")

    @rule(kind=st.sampled_from(KINDS), size=st.integers(0, 1460), source=st.sampled_from(PLACES))
    def anything(self, kind: int, size: int, source: Address) -> None:
        self.fire(bytes([kind]) + self.dice.randbytes(size), source)

    @rule(index=st.integers(0, 39), source=st.sampled_from(PLACES))
    def recorded(self, index: int, source: Address) -> None:
        self.fire(self.ground.recorded[index % len(self.ground.recorded)], source)

    @rule(index=st.integers(0, 39), bit=st.integers(0, 11199), source=st.sampled_from(PLACES))
    def bent(self, index: int, bit: int, source: Address) -> None:
        """Send a recorded datagram with one changed bit."""
        datagram = bytearray(self.ground.recorded[index % len(self.ground.recorded)])
        datagram[bit // 8 % len(datagram)] ^= 1 << bit % 8
        if datagram[0] != DISCOVERY:  # a DISCOVERY stays the same if only its nonce changes
            self.fire(bytes(datagram), source)

    @rule(source=st.sampled_from(PLACES), counter=st.integers(0, 2**64 - 1), size=st.integers(16, 200))
    def guessed_session(self, source: Address, counter: int, size: int) -> None:
        """Send DATA with the real session number, which the attacker knows because sessions send it unencrypted."""
        [index] = list(self.ground.target._sessions)[:1]
        head = bytes([DATA]) + index.to_bytes(4, "little") + counter.to_bytes(8, "little")
        self.fire(head + self.dice.randbytes(size), source)

    @rule(source=st.sampled_from(PLACES), size=st.integers(50, 1300))
    def guessed_handshake(self, source: Address, size: int) -> None:
        """Send RESP with the real number of a pending handshake."""
        for index in list(self.ground.target._peers._handshakes)[:1]:
            self.fire(bytes([RESP]) + index.to_bytes(4, "little") + self.dice.randbytes(size), source)

    @rule(source=st.sampled_from(PLACES), key=st.booleans())
    def discovery(self, source: Address, key: bool) -> None:
        """Send an unsolicited DISCOVERY_REPLY under another key or under the team's key."""
        secret = derive_key(TEAM, b"greet") if key else bytes(32)
        self.fire(pack_discovery_reply(secret, self.dice.randbytes(16), self.dice.randbytes(32), self.dice), source)

    @invariant()
    def nothing_changed(self) -> None:
        """Check that the state of the node is unchanged, and that no request got an answer."""
        if hasattr(self, "ground"):
            assert self.ground.state() == self.before
            assert self.answers == []


class SpoofingTests(SynchronousTestCase):
    def test_any_sequence(self) -> None:
        """No sequence of forged, changed, recorded and guessed datagrams changes the state of a node."""
        run_state_machine_as_test(Spoofing, settings=SEQUENCES)

    def test_the_machine_notices(self) -> None:
        """The test of random sequences fails if a node accepts one of these datagrams."""
        ground = Ground()
        self.addCleanup(ground.stop)
        before = ground.state()
        ground.shoot(sealed(ground, encode(Request(7, "add", (1,)))), member(ground).address)
        self.assertNotEqual(ground.state(), before)


class ElsewhereTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.ground = Ground()
        self.addCleanup(self.ground.stop)
        self.counters = self.ground.target.counters

    def test_answer_of_another_member(self) -> None:
        """An answer with a guessed request number is ignored if it comes from a different member."""
        ground = self.ground
        silent = Contact(Identity(b"s" * 32).public, Address("10.0.0.7", 7))
        asked = ground.target.ask(silent, "echo", 1)
        [number] = list(ground.target._requester._requests)
        for message in (Answer(number, "lie"), Failure(number, "refused", "lie")):
            ground.shoot(sealed(ground, encode(message)), member(ground).address)
        self.assertNoResult(asked)
        ground.clock.advance(5.0)
        self.failureResultOf(asked, NoAnswer)

    def test_greeting_from_elsewhere(self) -> None:
        """A DISCOVERY_REPLY with the right token, but not from the probed address, is dropped and counted."""
        ground = self.ground
        greeted = ground.target.discover(Address("10.0.0.8", 8))
        [token] = list(ground.target.discoverer._pending)
        key = derive_key(TEAM, b"greet")
        ground.shoot(pack_discovery_reply(key, token, Identity(b"e" * 32).public, random.Random(1)), STRANGER)
        self.assertNoResult(greeted)
        self.assertEqual(self.counters["misdirected"], 1)
        ground.clock.advance(5.0)
        self.failureResultOf(greeted, NoAnswer)

    def test_greeting_with_a_guessed_token(self) -> None:
        """A DISCOVERY_REPLY from the right address is dropped if its token is wrong."""
        ground = self.ground
        at = Address("10.0.0.8", 8)
        greeted = ground.target.discover(at)
        key = derive_key(TEAM, b"greet")
        ground.shoot(pack_discovery_reply(key, bytes(16), Identity(b"e" * 32).public, random.Random(1)), at)
        self.assertNoResult(greeted)
        ground.clock.advance(5.0)
        self.failureResultOf(greeted, NoAnswer)

    def test_who_of_a_stranger(self) -> None:
        """A DISCOVERY that is not encrypted under the team's key gets no reply."""
        datagram = pack_discovery(bytes(32), bytes(16), random.Random(1))
        self.assertEqual(self.ground.shoot(datagram), 0)
        self.assertEqual(self.counters["forged"], 1)
