"""Tests of the admission check: admission, rejections on both sides, and two nodes with one identity."""

from __future__ import annotations

import random
from typing import Any

from twisted.internet.defer import Deferred
from twisted.logger import ILogObserver, LogEvent, LogLevel, formatEvent, globalLogPublisher
from twisted.trial.unittest import SynchronousTestCase
from zope.interface import implementer

from middleware.entangled.contact import Contact
from middleware.entangled.errors import NoAnswer, NotAdmitted, Refused
from middleware.entangled.identity import Identity, derive_exchange_key
from middleware.entangled.network.network import Address, pack_address, parse_address
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import hash_key
from middleware.entangled.wire import admission_check
from middleware.entangled.wire.admission_check import (
    DOUBLED,
    EXPIRED,
    FOREIGN,
    LOG_BURST,
    REVOKED,
    ROLE,
    SUPERSEDED,
    Incarnation,
    Incarnations,
    LogLimiter,
    explain,
    next_incarnation,
)
from middleware.entangled.wire.endpoint import Endpoint
from middleware.entangled.wire.rejection import HOUR_S, MAX_REJECTIONS, Rejections
from middleware.entangled.wire.session import (
    DATA,
    INIT,
    MIN_ANSWER_BYTES,
    RESP,
    Credentials,
    HandshakeFields,
    InitiatorHandshake,
)
from tests.fleet import TEAM_KEY as FLEET_TEAM
from tests.fleet import EntangledTeam, FleetCase
from tests.middleware.gate import ROOM, Gate
from tests.middleware.test_endpoint import DELAY, TEAM, EndpointCase, Tap


class LogCase(SynchronousTestCase):
    """A test case that collects log messages."""

    def listened(self) -> list[str]:
        """Return a list that will contain all later warnings of the log."""
        lines: list[str] = []

        @implementer(ILogObserver)
        def seen(event: LogEvent) -> None:
            if event["log_level"] >= LogLevel.warn:
                lines.append(formatEvent(event))

        globalLogPublisher.addObserver(seen)
        self.addCleanup(globalLogPublisher.removeObserver, seen)
        return lines


class ClosedCase(EndpointCase, LogCase):
    """A test case with two endpoints of a closed team, each with a ``Gate``."""

    def setUp(self) -> None:
        self.gates: list[Gate] = []
        super().setUp()
        self.at_a, self.at_b = self.gates
        self.log = self.listened()

    def endpoint(
        self, seed: int, team: bytes = TEAM, port: int = 0, identity: int | None = None, gate: Gate | None = None
    ) -> tuple[Endpoint, Contact]:
        own = Identity(bytes([identity or seed]) * 32)
        tap = Tap(self.switchboard.make_network("127.0.0.1", port))
        self.gates.append(gate or Gate())
        endpoint = Endpoint(own, team, tap, self.clock, random.Random(seed), self.gates[-1])
        endpoint.start()
        self.taps[tap.address] = tap
        return endpoint, Contact(own.public, tap.address)

    def refused(self, asked: Deferred[Any], code: str, seconds: float = 3.0) -> str:
        """Return the error message of a request, after a check that the request was rejected with ``code``."""
        self.clock.advance(seconds)
        error = self.failureResultOf(asked, NotAdmitted).value
        self.assertEqual(error.code, code)
        return str(error)


class PassTests(ClosedCase):
    """Tests of the credential in a handshake, and of its check."""

    def test_first_answer_still_takes_one_round_trip(self) -> None:
        """With credentials of the maximum size a first request still fits into the INIT and takes one round trip."""
        answer = bytes(MIN_ANSWER_BYTES - 20)
        seen: list[tuple[Contact, Address]] = []
        self.a.on_seen.add(lambda contact, address: seen.append((contact, address)))
        asked = self.a.ask(self.to_b, "echo", answer)
        self.clock.advance(2 * DELAY)
        self.assertEqual(self.successResultOf(asked), answer)
        self.assertEqual((self.at_a.judged, self.at_b.judged), ([self.to_b.public], [self.to_a.public]))
        self.assertEqual(seen, [(self.to_b, self.to_a.address)])

    def test_refused_by_the_responder(self) -> None:
        """A node without a valid credential gets the reason; its request does not run, and no session is left."""
        self.at_b.refused[self.to_a.public] = EXPIRED
        self.b.expose("look", lambda peer: self.runs.append(peer), early=True)
        text = self.refused(self.a.ask(self.to_b, "look"), EXPIRED, 2 * DELAY)
        self.assertIn(explain(EXPIRED), text)
        self.assertEqual((self.runs, self.a._sessions, self.b._sessions), ([], {}, {}))

    def test_refused_by_the_initiator(self) -> None:
        """The initiator sends its rejection in the first DATA; neither side reports the other as a contact."""
        self.at_a.refused[self.to_b.public] = REVOKED
        met: list[Contact] = []
        refusals: list[tuple[Contact, str]] = []
        self.a.on_contact.add(met.append)
        self.b.on_contact.add(met.append)
        self.b.on_rejected.add(lambda contact, code: refusals.append((contact, code)))
        self.refused(self.a.ask(self.to_b, "echo", 1), REVOKED)
        self.assertEqual((met, refusals), ([], [(self.to_a, REVOKED)]))
        self.assertEqual((self.a._sessions, self.b._sessions), ({}, {}))
        self.assertEqual(len(self.kept(self.to_b, DATA)), 1)

    def test_said_once(self) -> None:
        """Each side logs each rejection once, with a remedy; a node with a new credential is admitted."""
        for count, code in enumerate((REVOKED, EXPIRED), start=1):
            self.at_b.refused[self.to_a.public] = code
            for _ in range(5):
                self.refused(self.a.ask(self.to_b, "echo", 1), code)
            self.assertEqual((len(self.kept(self.to_b, INIT)), len(self.log)), (5 * count, 2 * count))
            self.assertTrue(all(explain(code) in line for line in self.log[-2:]), self.log)
        del self.at_b.refused[self.to_a.public]
        self.assertEqual(self.got(self.a.ask(self.to_b, "echo", 2)), 2)

    def test_foreign_passes(self) -> None:
        """Missing and oversized credentials are rejected with the code "foreign".

        The admission check is not called for an oversized credential.
        """
        self.at_a.own_pass += b"!"
        self.refused(self.a.ask(self.to_b, "echo", 1), FOREIGN)
        self.assertEqual(self.at_b.judged, [])
        stranger, _ = self.endpoint(9, gate=Gate(shown=b""))
        self.refused(stranger.ask(self.to_b, "echo", 1), FOREIGN)

    def test_a_repeated_init_is_refused_without_a_key_exchange(self) -> None:
        """A repeated INIT gets the same rejection again, without a new check."""
        self.at_b.refused[self.to_a.public] = REVOKED
        self.refused(self.a.ask(self.to_b, "echo", 1), REVOKED)
        (init, source), judged = self.kept(self.to_b, INIT)[0], len(self.at_b.judged)
        self.taps[self.to_b.address].receiver(init, source)
        self.clock.advance(1)
        self.assertEqual((len(self.at_b.judged), self.b.counters["repeated"]), (judged, 1))
        first, second = (datagram for datagram, _ in self.kept(self.to_a, RESP))
        self.assertEqual(first, second)

    def test_a_forged_init_reaches_no_door(self) -> None:
        """An INIT with a wrong team secret, or without space for a credential, is dropped before the check."""
        for secret, hello in (
            (b"x" * 32, HandshakeFields(self.at_a.incarnation, self.at_a.own_pass, ROOM)),
            (TEAM, HandshakeFields()),
        ):
            own = Credentials.derive(Identity(b"m" * 32), secret)
            init = InitiatorHandshake(
                own, derive_exchange_key(self.to_b.public), bytes(range(32)), 5, b"", hello
            ).make_init()
            self.taps[self.to_b.address].receiver(init, self.to_a.address)
        self.clock.advance(1)
        self.assertEqual((self.at_b.judged, self.b.counters["forged"], self.kept(self.to_a, RESP)), ([], 2, []))

    def test_a_refusal_that_is_none(self) -> None:
        """A rejection with an invalid code is counted, and the session stays open."""
        self.got(self.a.ask(self.to_b, "echo", 1))
        session = next(iter(self.a._sessions.values()))
        for rubbish in (b"\x04", b"\x04\xff\xfe", b"\x04" + b"x" * 33):
            self.a._send(session, rubbish)
        self.clock.advance(1)
        self.assertEqual(self.b.counters["malformed"], 3)
        self.assertEqual(self.got(self.a.ask(self.to_b, "echo", 2)), 2)


class EvictionTests(ClosedCase):
    """Tests of members that were evicted."""

    def test_evicted_at_runtime(self) -> None:
        """An evicted node gets the reason, its running requests are cancelled, and its later requests are rejected."""
        never: Deferred[None] = Deferred()
        stopped: list[object] = []
        self.b.expose("wait", lambda peer: Deferred(lambda _: stopped.append(1)), changes=True)
        self.a.expose("wait", lambda peer: never, changes=True)
        mine = self.a.ask(self.to_b, "wait", timeout=60.0, changes=True)
        self.clock.advance(1)
        theirs = self.b.ask(self.to_a, "wait", timeout=60.0, changes=True)
        self.clock.advance(1)
        self.at_b.refused[self.to_a.public] = REVOKED
        self.b.evict(self.to_a.public)
        self.refused(theirs, REVOKED, 0.0)
        self.refused(mine, REVOKED, 2 * DELAY)
        self.assertEqual((stopped, self.a._sessions, self.b._sessions), ([1], {}, {}))
        self.refused(self.a.ask(self.to_b, "echo", 1), REVOKED)
        self.refused(self.b.ask(self.to_a, "echo", 1), REVOKED)
        self.assertEqual(len(self.log), 2)

    def test_evicted_in_the_middle_of_a_parcel(self) -> None:
        """An eviction ends the transfer of a large request, and both sides free its fragments."""
        asked = self.a.ask(self.to_b, "echo", bytes(500_000))
        self.clock.advance(6 * DELAY)
        self.b.evict(self.to_a.public)
        self.refused(asked, REVOKED)
        for end in (self.a, self.b):
            self.assertEqual((end._fragmenter._incoming, dict(end._fragmenter._bytes_in)), ({}, {}))
            self.assertEqual(dict(end._fragmenter._bytes_out), {})

    def test_evicted_before_it_confirmed(self) -> None:
        """An eviction also removes an unconfirmed session; the eviction of an unknown node has no effect."""
        self.b.evict(Identity(b"n" * 32).public)
        self.assertEqual(self.log, [])
        self.a.ask(self.to_b, "add", 1, changes=True).addErrback(lambda failure: None)
        self.clock.advance(1.5 * DELAY)
        self.b.evict(self.to_a.public)
        self.clock.advance(0.5 * DELAY)
        self.assertEqual((self.b._sessions, self.runs), ({}, []))


class IncarnationTests(ClosedCase):
    """Tests with two nodes that have one identity."""

    def life(self, number: int, nonce: int) -> tuple[Endpoint, Contact]:
        """Create another node with the identity of ``a``."""
        end, contact = self.endpoint(50 + nonce, identity=1, gate=Gate(number, nonce))
        self.equip(end)
        return end, contact

    def test_the_older_one_is_told(self) -> None:
        """A later incarnation is admitted.

        The earlier incarnation is rejected as superseded, in its session and later.
        """
        self.got(self.a.ask(self.to_b, "echo", 1))
        later, _ = self.life(2, 2)
        self.got(later.ask(self.to_b, "echo", 2))
        self.assertEqual((self.log, self.b.counters["refused"]), ([], 0))
        self.refused(self.a.ask(self.to_b, "echo", 3), SUPERSEDED)
        self.refused(self.a.ask(self.to_b, "echo", 3), SUPERSEDED)
        self.assertEqual(self.got(later.ask(self.to_b, "echo", 4)), 4)
        self.assertEqual(len(self.log), 2)
        self.assertTrue(all(explain(SUPERSEDED) in line for line in self.log))

    def test_a_copy_is_doubled(self) -> None:
        """An incarnation with the same number but another nonce, or with a lower number, is rejected as doubled."""
        self.at_a.incarnation = Incarnation(5, self.at_a.incarnation.nonce)
        self.got(self.a.ask(self.to_b, "echo", 1))
        for number, nonce in ((5, 2), (4, 3)):
            copy, _ = self.life(number, nonce)
            self.refused(copy.ask(self.to_b, "echo", 2), DOUBLED)
        self.assertEqual(self.got(self.a.ask(self.to_b, "echo", 3)), 3)

    def test_a_copy_that_answers(self) -> None:
        """A request that reaches a copy of the node is rejected; the session with the first node stays open."""
        self.equip(self.a)
        self.got(self.a.ask(self.to_b, "echo", 1))
        copy, to_copy = self.life(1, 2)
        session = self.b._peers.get(self.to_a.public).session  # type: ignore[union-attr]
        assert session is not None
        self.b._peers.open(self.b._peers.get_or_create(to_copy), to_copy.address)
        self.clock.advance(1)
        self.assertEqual(copy._sessions, {})
        self.assertIs(self.b._peers.get(self.to_a.public).session, session)  # type: ignore[union-attr]
        self.assertEqual(self.got(self.b.ask(self.to_a, "echo", 2)), 2)
        self.assertEqual(len(self.log), 2)

    def test_two_that_knock_at_once(self) -> None:
        """If two nodes with one incarnation number send INITs at the same time, the first to confirm is admitted."""
        copy, _ = self.life(1, 2)
        first, second = self.a.ask(self.to_b, "add", 1, changes=True), copy.ask(self.to_b, "add", 2, changes=True)
        self.clock.advance(3)
        results = [one.result for one in (first, second)]
        self.assertEqual(results[0], 1)
        self.assertEqual(self.failureResultOf(second, NotAdmitted).value.code, DOUBLED)
        self.assertEqual(self.runs, [1])

    def test_a_recording_sets_no_life(self) -> None:
        """A recorded INIT of an earlier incarnation does not change the table of incarnations."""
        self.got(self.a.ask(self.to_b, "echo", 1))
        recorded = self.kept(self.to_b, INIT)[0]
        later, _ = self.life(2, 2)
        self.got(later.ask(self.to_b, "echo", 2))
        self.clock.advance(60)
        self.taps[self.to_b.address].receiver(*recorded)
        self.clock.advance(1)
        self.assertEqual(self.got(later.ask(self.to_b, "echo", 4)), 4)

    def test_lives(self) -> None:
        """The latest incarnation is valid, the previous one superseded, and any other doubled.

        An incarnation with number 0 is always valid.
        """
        incarnations, one, two = Incarnations(), Incarnation(1, b"1" * 8), Incarnation(2, b"2" * 8)
        self.assertFalse(incarnations.record(b"a", one))
        self.assertEqual(incarnations.find_refusal(b"a", two), "")
        self.assertTrue(incarnations.record(b"a", two))
        answers = [
            incarnations.find_refusal(b"a", life)
            for life in (one, two, Incarnation(2, b"3" * 8), Incarnation(1, b"3" * 8), Incarnation())
        ]
        self.assertEqual(answers, [SUPERSEDED, "", DOUBLED, DOUBLED, ""])
        self.assertEqual(incarnations.find_refusal(b"b", one), "")
        incarnations.forget(b"a")
        self.assertEqual(incarnations.find_refusal(b"a", one), "")

    def test_tables_are_bounded(self) -> None:
        """The tables of incarnations and of logged rejections are bounded; the oldest entries are removed first."""
        self.patch(admission_check, "MAX_IDENTITIES", 3)
        self.patch(admission_check, "MAX_LOGGED", 3)
        incarnations, noted = Incarnations(), LogLimiter()
        for number in range(10):
            incarnations.record(bytes([number]), Incarnation(1, b"1" * 8))
            self.assertTrue(noted.should_log(0.0, bytes([number]), EXPIRED))
        self.assertEqual(len(incarnations), 3)
        self.assertFalse(noted.should_log(0.0, b"\x09", EXPIRED))
        self.assertTrue(noted.should_log(0.0, b"\x00", EXPIRED))

    def test_the_log_is_no_target(self) -> None:
        """Rejections of invented keys are logged at a limited rate; skipped rejections are logged later."""
        noted = LogLimiter()
        self.assertEqual(sum(noted.should_log(0.0, number, FOREIGN) for number in range(1000)), LOG_BURST)
        self.assertEqual(sum(noted.should_log(3.0, number, FOREIGN) for number in range(1000)), 3)

    def test_next_life(self) -> None:
        """An incarnation number is higher than the last number and at least the Unix time of the start."""
        self.assertEqual([next_incarnation(0, 0.0), next_incarnation(7, 5.0), next_incarnation(7, 1e9)], [1, 8, 10**9])


class SecretTests(ClosedCase):
    """The replacement of the team secret."""

    NEW, NEWER = b"n" * 32, b"N" * 32

    def test_both_are_good_for_a_while(self) -> None:
        """Until the old secret expires, nodes with the old and nodes with the new secret reach each other."""
        self.assertRaises(ValueError, self.b.replace_secrets, b"short")
        self.b.replace_secrets(self.NEW, TEAM)
        self.assertEqual(self.got(self.a.ask(self.to_b, "echo", 1), 4 * DELAY), 1)
        old, to_old = self.endpoint(7)
        self.equip(old)
        self.b.ask(to_old, "echo", 2).addErrback(lambda failure: failure.trap(NoAnswer))
        self.clock.advance(3)
        self.assertEqual(self.got(self.b.ask(to_old, "echo", 3)), 3)
        new, _ = self.endpoint(8, team=self.NEW)
        self.assertEqual(self.got(new.ask(self.to_b, "echo", 4), 4 * DELAY), 4)

    def test_cookies_under_each_secret(self) -> None:
        """Under load a member can decrypt its cookie, whether it has only the old secret or only the new one."""
        self.b.replace_secrets(self.NEW, TEAM)
        new, _ = self.endpoint(8, team=self.NEW)
        for requester in (self.a, new):
            self.b._cookies._limit._tokens = -1e6
            self.assertEqual(self.got(requester.ask(self.to_b, "echo", 1), 4 * DELAY), 1)

    def test_nobody_is_remembered_by_an_old_one(self) -> None:
        """A node contacts a peer under the secret of their last handshake, until only the new secret is valid."""
        self.equip(self.a)
        self.b.replace_secrets(self.NEW, TEAM)
        self.assertEqual(self.got(self.b.discover(self.to_a.address), 1.0), self.to_a)
        self.assertEqual(self.got(self.b.ask(self.to_a, "echo", 1), 2 * DELAY), 1)
        self.a.replace_secrets(self.NEW)
        self.b.replace_secrets(self.NEW)
        self.b._peers.evict(self.b._peers.get_or_create(self.to_a))
        self.assertEqual(self.got(self.b.ask(self.to_a, "echo", 2), 2 * DELAY), 2)


class RoleTests(ClosedCase):
    """Tests of methods that a role forbids."""

    def test_a_method_that_is_not_for_it(self) -> None:
        """Requests and one-way messages that the caller's role forbids do not run, and are logged once."""
        self.b.expose("told", lambda peer: self.runs.append("told"))
        self.at_b.forbidden = {(self.to_a.public, name) for name in ("add", "whole", "told")}
        for asked in (
            self.a.ask(self.to_b, "whole", 1),
            self.a.ask(self.to_b, "add", 1, changes=True),
            self.a.ask(self.to_b, "add", 1),
            self.a.ask(self.to_b, "whole", 1, "x" * 3000),
        ):
            self.clock.advance(3)
            self.assertEqual(self.failureResultOf(asked, Refused).value.code, ROLE)
        self.a.notify(self.to_b, "told")
        self.assertEqual(self.got(self.a.ask(self.to_b, "echo", 1)), 1)
        self.assertEqual((self.runs, len(self.log)), ([], 1))
        self.assertIn(explain(ROLE), self.log[0])


class RouteTests(EndpointCase):
    """Tests of datagrams of kinds that the endpoint itself does not handle."""

    def test_a_kind_has_one_receiver(self) -> None:
        """Datagrams of a routed kind go to their receiver; a kind that is already in use cannot be routed."""
        got: list[tuple[bytes, Address]] = []
        self.b.route(0x17, lambda datagram, source: got.append((datagram, source)))
        self.a.send_datagram(b"\x17 knock", self.to_b.address)
        self.clock.advance(1)
        self.assertEqual(got, [(b"\x17 knock", self.to_a.address)])
        for kind in (0x17, INIT):
            self.assertRaises(ValueError, self.b.route, kind, print)
        self.a.stop()
        self.a.send_datagram(b"\x17 knock", self.to_b.address)
        self.assertEqual(self.switchboard.counters["sent"], 1)


class AddressTests(SynchronousTestCase):
    """The binary encoding of addresses."""

    def test_there_and_back(self) -> None:
        """IPv4 and IPv6 addresses survive encoding and decoding; the zone of a link-local address is dropped."""
        for address in (Address("10.0.0.1", 8470), Address("255.255.255.255", 65535), Address("2001:db8::1", 1)):
            self.assertEqual(parse_address(pack_address(address)), address)
        self.assertEqual(parse_address(pack_address(Address("fe80::1%eth0", 7))), Address("fe80::1", 7))

    def test_what_is_no_address(self) -> None:
        """Host names and invalid input are encoded as an empty address, and truncated bytes are decoded as None."""
        for host, port in (
            ("robot.local", 1),
            ("~0102", 1),
            ("10.0.0", 1),
            ("10.0.0.256", 1),
            ("::x", 1),
            ("1.2.3.4", -1),
        ):
            packed = pack_address(Address(host, port))
            self.assertEqual((len(packed), parse_address(packed)), (18, None))
        self.assertIsNone(parse_address(bytes([1]) * 17))


class GatedFleet(EntangledTeam):
    """A simulated closed team; ``gates`` contains the admission checks by node number."""

    def __init__(self, n: int) -> None:
        self.gates: dict[int, Gate] = {}
        super().__init__(n)

    def make_node(self, place: int, lease: float = 1.0) -> EntangledNode:
        gate = self.gates[place] = Gate(self.life_count + 1, place + 1)
        network = self.switchboard.make_network(*self.address(place))
        identity, store, dice = self.identity(place), self.store(place), self.make_life_rng(place)
        return EntangledNode(identity, FLEET_TEAM, network, store, self.clock, dice, lease, self.clock.seconds, gate)

    def evict(self, place: int, by: tuple[int, ...]) -> None:
        """Let some members evict the node with this number."""
        public = self.identity(place).public
        for other in by:
            self.gates[other].refused[public] = REVOKED
            self.nodes[other].evict(public)


KEY = hash_key("somewhere")


class MemberTests(FleetCase, LogCase):
    """Tests of whole nodes with an admission check."""

    def gated(self, n: int) -> GatedFleet:
        """Return a team that is stopped after the test."""
        fleet = GatedFleet(n)
        self.worlds.append(fleet)
        return fleet

    def test_the_last_one_left_does_not_look_for_it(self) -> None:
        """If a node has evicted the only other member, it does not try to reach this member."""
        fleet = self.gated(2)
        fleet.evict(1, by=(0,))
        fleet.kill(1)
        fleet.run(3.0)  # until the pending traffic has ended
        sent = fleet.switchboard.counters["sent"]
        fleet.run(30.0)
        self.assertEqual(fleet.switchboard.counters["sent"], sent)

    def test_a_copy_of_a_member(self) -> None:
        """Other nodes do not remove a member if a copy of it is rejected, or if a copy replaces the first node."""
        for number, is_in in ((0, False), (99, True)):
            fleet = self.gated(3)
            public, life = fleet.identity(2).public, fleet.gates[2].incarnation
            gate = Gate(number or life.number, 77)
            network = fleet.switchboard.make_network("10.0.0.3", 3)
            copy = Endpoint(fleet.identity(2), FLEET_TEAM, network, fleet.clock, random.Random(5), gate)
            copy.start()
            self.addCleanup(copy.stop)
            node = fleet.nodes[0]
            peer = node.endpoint._peers.get(public)
            assert peer is not None
            node.endpoint._peers.open(peer, network.address)
            for _ in range(200):
                fleet.run(0.01)
                self.assertEqual(len(node.overlay.contacts()), 2)
            self.assertEqual(bool(copy._sessions), is_in)

    def test_a_slot_that_is_not_for_it(self) -> None:
        """A write that the node's role forbids is rejected immediately, and nothing is sent."""
        fleet = self.gated(2)
        fleet.gates[1].unwritable.add((fleet.identity(1).public, "order"))
        sent = fleet.switchboard.counters["sent"]
        error = self.failureResultOf(fleet.nodes[1].put(KEY, "order", b"x"), Refused).value
        self.assertEqual((error.code, fleet.switchboard.counters["sent"]), (ROLE, sent))

    def test_the_evicted_one_is_no_majority_by_itself(self) -> None:
        """If all members reject a node, it considers them absent, and has no majority by itself."""
        fleet = self.gated(4)
        fleet.evict(3, by=(0, 1, 2))
        fleet.run(5.0)
        self.assertEqual(len(fleet.nodes[3].overlay.members.list_absent()), 3)
        stored = fleet.nodes[3].put(KEY, "alone", b"1")
        fleet.run(5.0)
        self.failureResultOf(stored, NoAnswer)

    def test_a_recording_parts_nobody(self) -> None:
        """A replayed INIT with an expired credential is rejected; the member that it names keeps its leases."""
        fleet = self.gated(3)
        init = [d for d, to in self.recorded(fleet, 2) if d[0] == INIT][0]
        self.done(fleet, fleet.nodes[2].put(KEY, "here", b"2", "leased"))
        public = fleet.identity(2).public
        fleet.run(60.0)
        fleet.gates[0].refused[public] = EXPIRED
        stranger = fleet.switchboard.make_network("10.0.0.9", 9)
        stranger.listen(lambda datagram, source: None)
        stranger.send(init, fleet.address(0))
        lost: list[Contact] = []
        fleet.nodes[0].overlay.on_lost.add(lost.append)
        fleet.run(1.0)
        self.assertEqual((fleet.nodes[0].endpoint.counters["refused"], lost), (1, []))
        self.assertEqual([r.value for r in self.done(fleet, fleet.nodes[1].get(KEY))], [b"2"])

    def recorded(self, fleet: GatedFleet, place: int) -> list[tuple[bytes, Address]]:
        """Return the datagrams that a restarted node sends to join."""
        sent: list[tuple[bytes, Address]] = []
        fleet.kill(place)
        fleet.run(3.0)
        node = fleet.nodes[place] = fleet.make_node(place)
        network: Any = node._network
        send = network.send

        def noted(datagram: bytes, to: Address) -> None:
            sent.append((datagram, to))
            send(datagram, to)

        network.send = noted
        fleet.start_node(node, [fleet.address(0)])
        fleet.run(2.0)
        return [one for one in sent if one[1] == fleet.address(0)]


class RejectionTests(SynchronousTestCase):
    """Tests of ``Rejections``."""

    def setUp(self) -> None:
        self.rejections = Rejections()

    def met(self, who: bytes, now: float, code: str = "revoked") -> None:
        """Record a rejection in the list of rejections."""
        self.rejections.record(who, "10.0.0.1:7000", "we", code, "why; what to do", now)

    def test_count_what_happens_again(self) -> None:
        """Equal rejections of one key are one entry with the first and last time.

        A different code has a separate entry.
        """
        for now in (1.0, 2.0, 5.0):
            self.met(b"a", now)
        self.met(b"a", 6.0, "expired")
        found = [(each.code, each.first_at, each.last_at, each.count) for each in self.rejections.list_recent(6.0)]
        self.assertEqual(found, [("expired", 6.0, 6.0, 1), ("revoked", 1.0, 5.0, 3)])

    def test_forget_after_an_hour(self) -> None:
        """A rejection older than an hour is not returned; if it occurs again, its count starts at one."""
        self.met(b"a", 0.0)
        self.assertEqual(self.rejections.list_recent(HOUR_S + 1.0), [])
        self.met(b"a", HOUR_S + 1.0)
        self.assertEqual([each.count for each in self.rejections.list_recent(HOUR_S + 1.0)], [1])

    def test_invented_keys_take_no_room(self) -> None:
        """Only the latest rejections are stored, whatever the number of invented keys."""
        for number in range(10 * MAX_REJECTIONS):
            self.met(number.to_bytes(32), float(number))
        self.assertEqual((len(self.rejections), self.rejections.list_recent(700.0)[0].last_at), (MAX_REJECTIONS, 639.0))
