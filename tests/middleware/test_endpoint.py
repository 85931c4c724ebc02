"""Tests of the endpoint, with two or three endpoints in virtual time on a switchboard."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from middleware.entangled.contact import Contact
from middleware.entangled.errors import NoAnswer, NotRunning, Refused, TooLarge
from middleware.entangled.identity import Identity, derive_exchange_key
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import LinkConditions, Switchboard, SwitchboardNetwork
from middleware.entangled.wire import method, peer
from middleware.entangled.wire.endpoint import Endpoint
from middleware.entangled.wire.message import MAX_MESSAGE_BYTES
from middleware.entangled.wire.peer import SESSION_END_S, SESSION_SILENCE_S
from middleware.entangled.wire.session import DATA, INIT, MAX_PLAIN_BYTES, RESP, InitiatorHandshake

TEAM = b"k" * 32
DELAY = 1 / 64  # a power of two, so sums of delays are exact


class Tap:
    """A ``Network`` that records the received datagrams and forwards them."""

    def __init__(self, network: SwitchboardNetwork) -> None:
        self.network = network
        self.kept: list[tuple[bytes, Address]] = []
        self.receiver: Any = None

    @property
    def address(self) -> Address:
        """The address of the underlying network."""
        return self.network.address

    def listen(self, receiver: Any) -> None:
        """Listen and record."""
        self.receiver = receiver
        self.network.listen(self._receive)

    def _receive(self, datagram: bytes, source: Address) -> None:
        self.kept.append((datagram, source))
        self.receiver(datagram, source)

    def send(self, datagram: bytes, to: Address) -> None:
        """Send a datagram."""
        self.network.send(datagram, to)

    def close(self) -> None:
        """Close the network."""
        self.network.close()


class EndpointCase(SynchronousTestCase):
    """A test case with two endpoints ``a`` and ``b``; ``b`` has some methods."""

    def setUp(self) -> None:
        """Start both endpoints."""
        self.clock = HeapClock()
        self.rng = random.Random(11)
        self.switchboard = Switchboard(self.clock, self.rng, LinkConditions(DELAY))
        self.taps: dict[Address, Tap] = {}
        self.runs: list[object] = []
        self.a, self.to_a = self.endpoint(1)
        self.b, self.to_b = self.endpoint(2)
        self.equip(self.b)

    def equip(self, endpoint: Endpoint) -> None:
        """Register the methods."""
        endpoint.expose("echo", lambda peer, value: value, early=True)
        endpoint.expose("add", self.add, changes=True)
        endpoint.expose("refuse", self.refuse)
        endpoint.expose("whole", self.whole)

    def add(self, peer: Contact, value: int) -> int:
        """Record the call."""
        self.runs.append(value)
        return value

    def refuse(self, peer: Contact) -> None:
        """Reject the call."""
        raise Refused("not today")

    def whole(self, peer: Contact, number: int, name: str | None = None) -> list[object]:
        """Return the arguments."""
        return [number, name]

    def endpoint(
        self, seed: int, team: bytes = TEAM, port: int = 0, identity: int | None = None
    ) -> tuple[Endpoint, Contact]:
        """Return a started endpoint and its contact."""
        own = Identity(bytes([identity or seed]) * 32)
        tap = Tap(self.switchboard.make_network("127.0.0.1", port))
        endpoint = Endpoint(own, team, tap, self.clock, random.Random(seed))
        endpoint.start()
        self.taps[tap.address] = tap
        return endpoint, Contact(own.public, tap.address)

    def got(self, deferred: Deferred[Any], seconds: float = 3.0) -> Any:
        """Let some time pass; return the result of a Deferred."""
        self.clock.advance(seconds)
        return self.successResultOf(deferred)

    def failed(self, deferred: Deferred[Any], kind: type[Exception], seconds: float = 3.0) -> str:
        """Let some time pass; return the error message of a Deferred."""
        self.clock.advance(seconds)
        return str(self.failureResultOf(deferred, kind).value)

    def kept(self, contact: Contact, kind: int) -> list[tuple[bytes, Address]]:
        """Return the received datagrams of one kind."""
        return [item for item in self.taps[contact.address].kept if item[0][0] == kind]


class AskTests(EndpointCase):
    """Requests and replies."""

    def test_change_waits_for_the_session(self) -> None:
        """The first request that changes state takes two round trips, because it must not run from an INIT.

        Later requests take one round trip.
        """
        self.assertEqual(self.got(self.a.ask(self.to_b, "add", 1, changes=True), 4 * DELAY), 1)
        self.assertEqual(self.got(self.a.ask(self.to_b, "add", 2, changes=True), 2 * DELAY), 2)
        self.assertEqual(self.switchboard.counters["sent"], 6)
        other, _ = self.endpoint(3)
        asked = other.ask(self.to_b, "add", 5)
        self.clock.advance(2 * DELAY)
        self.assertEqual(self.runs, [1, 2])
        self.assertEqual((self.got(asked), self.runs), (5, [1, 2, 5]))

    def test_long_questions(self) -> None:
        """A request that is too long for an INIT waits for the session.

        A request that cannot be encoded fails immediately.
        """
        self.assertEqual(len(self.got(self.a.ask(self.to_b, "echo", bytes(1330)))), 1330)

        self.failureResultOf(self.a.ask(self.to_b, "echo", object()), TypeError)
        self.assertRaises(TooLarge, self.a.notify, self.to_b, "echo", bytes(MAX_PLAIN_BYTES))

    def test_refusals(self) -> None:
        """A rejection, an unknown method, invalid arguments and an oversized result give an error message."""
        self.b.expose("fill", lambda peer, count: bytes(count))
        ask = self.a.ask
        self.assertEqual(self.failed(ask(self.to_b, "refuse"), Refused), "not today")
        self.assertIn("no such method", self.failed(ask(self.to_b, "nothing"), Refused))
        self.assertIn("takes 1 arguments", self.failed(ask(self.to_b, "echo"), Refused))
        self.assertIn("takes 1 to 2 arguments", self.failed(ask(self.to_b, "whole"), Refused))
        self.assertIn("argument 1 must be int, not str", self.failed(ask(self.to_b, "whole", "x"), Refused))
        self.assertIn("argument 2 must be str or None", self.failed(ask(self.to_b, "whole", 1, b"x"), Refused))
        self.assertIn("request less", self.failed(ask(self.to_b, "fill", MAX_MESSAGE_BYTES), Refused))
        self.assertEqual(self.got(ask(self.to_b, "whole", 1, None)), [1, None])

    def test_foreign_exceptions_stay_inside(self) -> None:
        """An exception in a method and a result that cannot be encoded are logged; the caller gets no details."""
        self.b.expose("crash", lambda peer: 1 // 0)
        self.b.expose("odd", lambda peer: object())
        for name in ("crash", "odd"):
            self.assertEqual(self.failed(self.a.ask(self.to_b, name), Refused), "internal error")
        self.assertEqual(len(self.flushLoggedErrors(ZeroDivisionError)), 1)

    def test_slow_methods(self) -> None:
        """Asynchronous methods reply when they have finished, run once, and may take longer than one retransmission."""
        waiting: list[Deferred[int]] = []

        async def slow(peer: Contact) -> int:
            waiting.append(Deferred())
            return await waiting[-1] + 1

        self.b.expose("slow", slow)
        self.b.expose("change", slow, changes=True)
        self.got(self.a.ask(self.to_b, "echo", 1))
        for name, patience in (("slow", None), ("change", None), ("slow", 20.0)):
            del waiting[:]
            asked = self.a.ask(self.to_b, name, timeout=patience)
            self.clock.advance(1.3 if patience is None else 19.0)
            self.assertNoResult(asked)
            self.assertEqual(len(waiting), 1)
            waiting[0].callback(41)
            self.assertEqual(self.got(asked, 0.1), 42)

    def test_no_answer(self) -> None:
        """Without a reply a request fails after four tries, which take 1.5 s, or less for a peer that is near."""
        asked = self.a.ask(Contact(self.to_b.public, Address("127.0.0.1", 9)), "echo", 1)
        self.clock.advance(1.4)
        self.assertNoResult(asked)
        self.failed(asked, NoAnswer, 0.2)
        self.assertEqual(self.switchboard.counters["unheard"], 4)
        self.got(self.a.ask(self.to_b, "echo", 1))
        self.switchboard.kill(self.to_b.address)
        self.failed(self.a.ask(self.to_b, "echo", 1), NoAnswer, 1.0)
        self.failed(self.a.ask(self.to_b, "echo", 1, timeout=0.1), NoAnswer, 0.11)
        self.assertIn(
            "is invalid", self.failed(self.a.ask(Contact(b"\xff" * 32, self.to_b.address), "echo", 1), NoAnswer)
        )
        self.a.stop()
        self.b.stop()
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def test_cancelled_question_is_forgotten(self) -> None:
        """A cancelled request leaves no timer, and its late reply is only counted."""
        self.got(self.a.ask(self.to_b, "echo", 1))
        asked = self.a.ask(self.to_b, "echo", 2)
        asked.cancel()
        self.failed(asked, Exception)
        self.assertEqual(self.a.counters["unasked"], 1)

    def test_both_open_at_once(self) -> None:
        """If two endpoints start handshakes with each other at the same time, both get replies to all requests."""
        self.equip(self.a)
        both = [self.a.ask(self.to_b, "add", 1, changes=True), self.b.ask(self.to_a, "add", 2, changes=True)]
        self.clock.advance(1)
        self.assertEqual([self.successResultOf(one) for one in both], [1, 2])
        both = [self.a.ask(self.to_b, "echo", 3), self.b.ask(self.to_a, "echo", 4)]
        self.clock.advance(1)
        self.assertEqual([self.successResultOf(one) for one in both], [3, 4])

    def test_contacts_are_reported_when_proved(self) -> None:
        """The caller reports its peer as a contact at the reply, the callee at the confirmation of the session."""
        seen: list[tuple[float, str, Contact]] = []
        self.a.on_contact.add(lambda contact: seen.append((self.clock.seconds(), "a", contact)))
        self.b.on_contact.add(lambda contact: seen.append((self.clock.seconds(), "b", contact)))
        self.got(self.a.ask(self.to_b, "echo", 1))
        self.assertIn((2 * DELAY, "a", self.to_b), seen)
        self.assertEqual([item for item in seen if item[1] == "b"], [(3 * DELAY, "b", self.to_a)])


class NotifyTests(EndpointCase):
    """One-way messages, key requests, start and stop."""

    def test_tells_open_a_session_and_arrive_once(self) -> None:
        """One-way messages that are sent before the session exists arrive in order after the handshake, each once."""
        self.switchboard.conditions = LinkConditions(DELAY, duplicate=1.0)
        for number in range(5):
            self.a.notify(self.to_b, "add", number)
        self.clock.advance(1)
        self.a.notify(self.to_b, "add", 5)
        self.a.notify(self.to_b, "nothing")
        self.a.notify(self.to_b, "refuse")
        self.clock.advance(1)
        self.assertEqual(self.runs, [0, 1, 2, 3, 4, 5])
        self.assertEqual((self.b.counters["unknown method"], self.b.counters["refused"]), (1, 1))

    def test_tells_that_cannot_arrive_are_counted(self) -> None:
        """One-way messages to an unreachable peer are dropped and counted, and the length of their queue is limited."""
        for number in range(100):
            self.a.notify(Contact(self.to_b.public, Address("127.0.0.1", 9)), "add", number)
        self.clock.advance(5)
        self.assertEqual(self.a.counters["untold"], 100)
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def test_greeting(self) -> None:
        """``greet`` learns the key at an address, also under loss; the reply is not larger than the request."""
        self.switchboard.conditions = LinkConditions(DELAY, loss=0.3)
        self.assertEqual(self.got(self.a.discover(self.to_b.address)), self.to_b)
        sizes = {len(datagram) for tap in self.taps.values() for datagram, _ in tap.kept}
        self.assertEqual(len(sizes), 1)
        self.failed(self.a.discover(Address("127.0.0.1", 9)), NoAnswer)

    def test_stopped_endpoint_fails_everything(self) -> None:
        """A stop fails pending and later calls and leaves no timer; the endpoint can start again."""
        pending = [self.a.ask(self.to_b, "echo", 1), self.a.discover(Address("127.0.0.1", 9))]
        self.a.stop()
        self.a.stop()
        pending += [self.a.ask(self.to_b, "echo", 1), self.a.discover(self.to_b.address)]
        for one in pending:
            self.failureResultOf(one, NotRunning)
        self.assertRaises(NotRunning, self.a.notify, self.to_b, "echo", 1)
        self.assertEqual([call.getTime() for call in self.clock.getDelayedCalls()], [DELAY, DELAY])  # in transit
        self.a.start()
        self.assertEqual(self.got(self.a.ask(self.to_b, "echo", 2)), 2)


class WeatherTests(EndpointCase):
    """Tests with loss, duplication, restarts and address changes."""

    def test_restarted_peer_answers_again(self) -> None:
        """A peer that lost its sessions or changed its address answers the next request within half a second."""
        self.got(self.a.ask(self.to_b, "echo", 1))
        for seed, name, port in (
            (3, "echo", self.to_b.address.port),
            (4, "add", self.to_b.address.port),
            (5, "add", 0),
        ):
            self.switchboard.kill(self.to_b.address)
            self.b, self.to_b = self.endpoint(seed, port=port, identity=2)
            self.equip(self.b)
            self.assertEqual(self.got(self.a.ask(self.to_b, name, seed, changes=name == "add"), 0.5), seed)
        self.switchboard.kill(self.to_b.address)
        self.b, self.to_b = self.endpoint(6, port=self.to_b.address.port, identity=2)
        self.equip(self.b)
        for number in range(10):  # one-way messages also reveal a restart
            self.a.notify(self.to_b, "add", 10 + number)
            self.clock.advance(1)
        self.assertIn(19, self.runs)

    def test_address_follows_the_key(self) -> None:
        """Replies go to the source of a peer's newest datagram; a replayed datagram does not change this address."""
        self.got(self.a.ask(self.to_b, "echo", 1))
        old = self.taps[self.to_a.address]
        moved = self.switchboard.make_network("127.0.0.1", 40000)
        moved.listen(old.receiver)
        old.network = moved
        seen: list[Contact] = []
        self.equip(self.a)
        self.assertEqual(self.got(self.a.ask(self.to_b, "echo", 2)), 2)
        recorded = self.kept(self.to_b, DATA)[-1][0]
        self.taps[self.to_b.address].receiver(recorded, Address("127.0.0.1", 666))
        self.b.on_contact.add(seen.append)
        self.assertEqual(self.got(self.b.ask(self.to_a, "echo", 3)), 3)
        self.assertEqual(seen, [Contact(self.to_a.public, Address("127.0.0.1", 40000))])

    def test_nobody_is_asked_on_a_session_that_may_be_gone(self) -> None:
        """In a large network a request after a long silence takes one round trip, even if the peer's session ended."""
        self.a.peers.is_large = self.b.peers.is_large = True
        self.got(self.a.ask(self.to_b, "echo", 1))
        self.clock.advance(SESSION_SILENCE_S - 3.5)
        self.assertEqual(self.got(self.a.ask(self.to_b, "echo", 2), 2 * DELAY), 2)
        self.assertEqual(len(self.kept(self.to_b, INIT)), 1)
        self.clock.advance(SESSION_SILENCE_S + 1)
        self.b.forget_silent(SESSION_SILENCE_S)
        self.assertFalse(self.a.has_session(self.to_b))
        self.assertEqual(self.got(self.a.ask(self.to_b, "echo", 3), 2 * DELAY), 3)
        self.assertTrue(self.a.has_session(self.to_b))

    def test_keys_of_an_idle_session_are_forgotten(self) -> None:
        """An idle session sends nothing.

        When it ends, both sides delete its keys, and a request opens a new session.
        """
        self.got(self.a.ask(self.to_b, "echo", 1))
        sent = self.switchboard.counters["sent"]
        self.clock.advance(SESSION_END_S - 4.0)
        self.assertTrue(self.a.has_session(self.to_b))
        self.clock.advance(2.0)
        self.assertEqual([len(end._sessions) for end in (self.a, self.b)], [0, 0])
        self.assertEqual(self.clock.getDelayedCalls(), [])
        self.assertEqual(self.switchboard.counters["sent"], sent)
        self.assertFalse(self.a.has_session(self.to_b))
        self.assertEqual(self.got(self.a.ask(self.to_b, "echo", 2), 2 * DELAY), 2)
        self.assertEqual(len(self.kept(self.to_b, INIT)), 2)

    def test_used_session_is_renewed(self) -> None:
        """A session in use is renewed every 120 s by one handshake, and each reply still takes one round trip."""
        for seconds in range(600):
            requester, to = (self.a, self.to_b) if seconds % 2 else (self.b, self.to_a)
            requester.notify(to, "echo", seconds)
            asked = self.a.ask(self.to_b, "echo", seconds)
            self.clock.advance(2 * DELAY)
            self.assertEqual(self.successResultOf(asked), seconds)
            self.clock.advance(1.0 - 2 * DELAY)
            for end in (self.a, self.b):
                self.assertLessEqual(len(end._sessions), peer.MAX_SESSIONS)
                ages = [self.clock.seconds() - session.opened_at for session in end._sessions.values()]
                self.assertLessEqual(max(ages), SESSION_END_S + 1.0)
        inits = [len(self.kept(to, INIT)) for to in (self.to_a, self.to_b)]
        self.assertIn(sum(inits), (5, 6, 7))

    def test_session_that_cannot_be_renewed_is_dropped(self) -> None:
        """If the peer does not reply, nothing is sent under keys that expired by age or by use."""
        for tells, seconds in ((200, 1.0), (30, 0.0)):
            self.got(self.a.ask(self.to_b, "echo", 1))
            self.switchboard.cut(self.to_a.address, self.to_b.address)
            for _ in range(tells):
                self.a.notify(self.to_b, "echo", 1)
                self.clock.advance(seconds)
            self.assertEqual(self.a._peers.get(self.to_b.public).sessions, ())  # type: ignore[union-attr]
            self.patch(peer, "SESSION_DATAGRAMS", 5)
            self.switchboard.heal()
            self.clock.advance(10.0)

    def test_worn_session_is_renewed(self) -> None:
        """A session is renewed after its limit of datagrams, and is not used for more than twice the limit."""
        self.patch(peer, "SESSION_DATAGRAMS", 20)
        worn = 0
        for number in range(100):
            self.assertEqual(self.got(self.a.ask(self.to_b, "add", number, changes=True)), number)
            worn = max([worn, *(session.sent for session in self.a._sessions.values())])
        self.assertEqual(self.runs, list(range(100)))
        handshakes = len(self.kept(self.to_a, INIT)) + len(self.kept(self.to_b, INIT))
        self.assertIn(handshakes, range(4, 11))
        self.assertLessEqual(worn, 41)


class AttackTests(EndpointCase):
    """Tests of datagrams that must have no effect."""

    def send_raw(self, datagram: bytes, source: Address = Address("127.0.0.1", 666)) -> int:  # noqa: B008
        """Deliver a datagram to ``b`` and return the number of datagrams that ``b`` sends in response."""
        before = self.switchboard.counters["sent"]
        self.taps[self.to_b.address].receiver(datagram, source)
        self.clock.advance(2 * DELAY)
        return self.switchboard.counters["sent"] - before

    def test_response_counts_only_from_where_it_was_asked(self) -> None:
        """A RESP from an address to which no INIT was sent, or a repeated RESP, opens no session."""
        asked = self.a.ask(self.to_b, "echo", 1)
        self.clock.advance(1.5 * DELAY)
        tap = self.taps[self.to_a.address]
        genuine = tap.receiver
        tap.receiver = lambda datagram, source: None
        self.clock.advance(DELAY)
        response, source = self.kept(self.to_a, RESP)[0]
        genuine(response, Address("127.0.0.1", 666))
        damaged = bytearray(response)
        damaged[40] ^= 1
        genuine(bytes(damaged), source)
        genuine(response[:20], source)
        self.assertNoResult(asked)
        genuine(response, source)
        genuine(response, source)
        self.assertEqual(self.successResultOf(asked), 1)
        counted = [self.a.counters[name] for name in ("misdirected", "forged", "malformed", "stale")]
        self.assertEqual(counted, [1, 1, 1, 1])

    def test_malformed_messages_of_members(self) -> None:
        """Invalid messages from a member are counted, and the session stays open."""
        self.got(self.a.ask(self.to_b, "echo", 1))
        session = next(iter(self.a._sessions.values()))
        for rubbish in (b"\xc1", b"\x93\x01", b"\x90", self.rng.randbytes(300)):
            self.assertEqual(self.send_raw(session.seal(rubbish), self.to_a.address), 0)
        invitation = InitiatorHandshake(
            self.a._credentials, derive_exchange_key(self.to_b.public), bytes(range(32)), 5, b"\xc1"
        )
        self.assertEqual(self.send_raw(invitation.make_init()), 0)
        self.assertEqual(self.b.counters, {"malformed": 5})
        self.assertEqual(self.got(self.a.ask(self.to_b, "echo", 2)), 2)

    def test_key_of_another_is_not_believed(self) -> None:
        """An INIT with the public key of another member gets no reply and creates no session."""
        thief = replace(self.a._credentials, public=Identity(b"v" * 32).public)
        for own in (thief, replace(self.a._credentials, public=b"\xff" * 32)):
            invitation = InitiatorHandshake(own, derive_exchange_key(self.to_b.public), self.rng.randbytes(32), 5, b"")
            self.assertEqual(self.send_raw(invitation.make_init()), 0)
        self.assertEqual((self.b.counters, self.b._sessions), ({"forged": 2}, {}))

    def test_peers_stay_bounded(self) -> None:
        """The number of peers is limited.

        The peer that has been idle longest is removed with its sessions, and may return.
        """
        self.patch(peer, "MAX_PEERS", 5)
        contacts = []
        for seed in range(20, 30):
            other, contact = self.endpoint(seed)
            self.equip(other)
            contacts.append(contact)
            self.assertEqual(self.got(self.a.ask(contact, "echo", seed)), seed)
        self.assertEqual((len(self.a._peers._peers), len(self.a._sessions)), (5, 5))
        self.assertEqual(self.got(self.a.ask(contacts[0], "echo", 1)), 1)

    def test_answers_under_way_stay_bounded(self) -> None:
        """Long requests of a peer beyond the limit are rejected and do not run."""
        self.patch(method, "MAX_PER_PEER", 3)
        self.got(self.a.ask(self.to_b, "echo", 1))
        asked = [self.a.ask(self.to_b, "add", number, changes=True) for number in range(5)]
        self.clock.advance(1)
        self.assertEqual([self.successResultOf(one) for one in asked[:3]], [0, 1, 2])
        for one in asked[3:]:
            self.assertIn("try again later", str(self.failureResultOf(one, Refused).value))
        self.assertEqual(self.runs, [0, 1, 2])
        self.clock.advance(40)
        self.assertEqual(self.got(self.a.ask(self.to_b, "add", 9, changes=True)), 9)
