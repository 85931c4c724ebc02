"""Attack S8: make a node send more than it receives, to a third party, or on behalf of nodes outside the team."""

from __future__ import annotations

import random
from collections import Counter
from typing import Any

from middleware.admission import join_codec
from middleware.entangled.clock import HeapClock
from middleware.entangled.identity import Identity, derive_exchange_key
from middleware.entangled.nat.relay import (
    ALL_BURST,
    ALL_RATE,
    MAX_PAIRS,
    PAIR_BURST,
    PAIR_RATE,
    RELAY_REQUEST,
    Relay,
)
from middleware.entangled.network.network import MAX_DATAGRAM_BYTES, Address, relayed_address
from middleware.entangled.wire.discovery import pack_discovery
from middleware.entangled.wire.message import Request, encode
from middleware.entangled.wire.probe import pack_probe
from middleware.entangled.wire.session import Credentials, HandshakeFields, InitiatorHandshake, derive_key
from tests.attacks.siege import OneSession, SiegeCase
from tests.middleware.admission.village import network_of

VICTIM = Address("10.7.7.7", 77)


class AmplificationTests(SiegeCase):
    def setUp(self) -> None:
        """Create a team of eight, so answers are long, and count the bytes that one node sends to each address."""
        super().setUp()
        self.team = self.village()
        for name in ("dog", "cat", "pig", "cow", "hen", "fox", "owl"):
            self.team.enlist(name)
        self.house = self.team.houses[0]
        port: Any = network_of(self.house)
        self.network = port
        self.sent: Counter[Address] = Counter()
        send = self.network.send

        def sends(datagram: bytes, to: Address) -> None:
            self.sent[to] += len(datagram)
            send(datagram, to)

        port.send = sends
        self.dice = random.Random(1)

    def back(self, datagram: bytes, seconds: float = 2.0) -> int:
        """Return the number of bytes that a victim receives after one datagram with its address as source."""
        self.sent.clear()
        self.network.receiver(datagram, VICTIM)
        self.team.run(seconds)
        return self.sent[VICTIM]

    def test_every_kind(self) -> None:
        """No reply to an unverified address is longer than its request."""
        secret = self.house.team.secret
        own = Credentials.derive(Identity(b"i" * 32), secret)
        remote = derive_exchange_key(self.house.public)
        request = encode(Request(1, "find_node", (bytes(20),)))
        paper = self.team.paper("ape")
        passes = {"no": b"", "good": paper.certificate, "long": paper.certificate.ljust(640, b"x")}
        code, packed, terms = self.team.signer.invite("cub", ("device",), 1, self.team.wall(), 900.0, self.dice)
        self.team.tell(terms)
        self.team.tell(packed)
        self.team.run(2.0)
        cub = Identity(b"c" * 32)
        sent = {
            "who": pack_discovery(derive_key(secret, b"greet"), bytes(16), self.dice),
            "hail": pack_probe(bytes(16)),
            "knock": join_codec.make_request(code.key, cub.public, derive_exchange_key(cub.public), "", self.dice),
            "strange knock": bytes([join_codec.JOIN_REQUEST]) + self.dice.randbytes(join_codec.JOIN_REQUEST_BYTES - 1),
        }
        for name, shown in passes.items():
            member = Credentials.derive(paper.identity, secret) if shown == paper.certificate else own
            for early_message in (b"", request):
                hello = HandshakeFields(self.house.team.admission.incarnation, shown, 640)
                made = InitiatorHandshake(
                    member, remote, self.dice.randbytes(32), self.dice.getrandbits(31), early_message, hello
                )
                sent[f"init with {name} pass{', asks' * bool(early_message)}"] = made.make_init()
        ratios = {name: self.back(datagram) / len(datagram) for name, datagram in sent.items()}
        answered = [name for name, ratio in ratios.items() if ratio]
        self.assertGreater(len(answered), 7, ratios)
        self.assertLessEqual(max(ratios.values()), 1.0, ratios)

    def test_again_and_again(self) -> None:
        """A hundred copies of a recorded INIT cause replies with at most as many bytes as the copies."""
        own = Credentials.derive(Identity(b"i" * 32), self.house.team.secret)
        made = InitiatorHandshake(
            own,
            derive_exchange_key(self.house.public),
            bytes(31) + b"\x02",
            9,
            b"",
            HandshakeFields(max_pass_bytes=640),
        )
        datagram = made.make_init()
        back = sum(self.back(datagram, 0.01) for _ in range(100))
        self.assertLessEqual(back, 100 * len(datagram))

    def test_others_are_not_drawn_in(self) -> None:
        """Datagrams of nodes outside the team do not make a node send more to third parties."""
        self.team.run(10.0)
        self.sent.clear()
        self.team.run(5.0)
        usual = sum(self.sent.values())
        self.sent.clear()
        for _ in range(500):
            self.network.receiver(self.dice.randbytes(1200), VICTIM)
            self.network.receiver(pack_probe(self.dice.randbytes(16)), VICTIM)
        self.team.run(5.0)
        self.sent.pop(VICTIM, None)
        self.assertLessEqual(sum(self.sent.values()), 1.2 * usual + 2000)


class IntroductionTests(SiegeCase):
    def test_knocks_at_a_victim(self) -> None:
        """If a member requests introductions to a victim's address, the rate of bytes to this address is limited."""
        team = self.village()
        bad, _ = self.insider(team, "bad")
        self.outcome(team, bad.ask(team.contact(team.houses[0]), "ping", bytes(8), changes=True))
        network: Any = network_of(team.houses[0])
        sent: list[int] = []
        send = network.send

        def sends(datagram: bytes, to: Address) -> None:
            if to.host == VICTIM.host:
                sent.append(len(datagram))
            send(datagram, to)

        network.send = sends
        dice = random.Random(1)
        totals = []
        for _ in range(2):
            sent.clear()
            for _ in range(1000):
                public = Identity(dice.randbytes(32)).public
                found = [[VICTIM.host, 1 + dice.randrange(60000)] for _ in range(6)]
                asked = bad.ask(team.contact(team.houses[0]), "reach.meet", public, found, 0, changes=True)
                asked.addErrback(lambda failure: None)
                team.run(0.01)
            totals.append(sum(sent))
        self.assertGreater(totals[0], 0)
        self.assertLess(totals[0], 15_000_000)
        self.assertLess(totals[1] / 10, 250_000)


class RelayTests(SiegeCase):
    def test_a_stranger_is_not_carried_for(self) -> None:
        """A relay forwards a datagram only if it receives it in a session, and drops the same bytes otherwise."""
        team = self.village()
        team.enlist("dog")
        network: Any = network_of(team.houses[0])
        to = team.houses[1].node.contact.node_id
        before = team.houses[0].node.endpoint.counters["carried"]
        network.receiver(bytes([RELAY_REQUEST]) + to + bytes(500), VICTIM)
        team.run(1.0)
        self.assertEqual(team.houses[0].node.endpoint.counters["carried"], before)

    def test_a_revoked_one_is_not_carried_for(self) -> None:
        """A relay stops forwarding for a revoked member."""
        team = self.village()
        team.enlist("dog")
        paper = team.paper("bad")
        bad = self.attacker(team, paper.identity, paper.secrets[0][1], paper.certificate)
        self.outcome(team, bad.ask(team.contact(team.houses[0]), "ping", bytes(8), changes=True))
        counters = team.houses[0].node.endpoint.counters

        def carry() -> int:
            before = counters["carried"]
            session = next(iter(bad._sessions.values()), None)
            if session is not None:
                to = team.houses[1].node.contact.node_id
                bad._network.send(session.seal(bytes([RELAY_REQUEST]) + to + bytes(200)), team.address(0))
                team.run(0.1)
            return counters["carried"] - before

        self.assertEqual(carry(), 1)
        session = next(iter(bad._sessions.values()))
        team.tell(team.signer.revoke(paper.identity.public, "bad", team.wall()))
        team.run(2.0)
        bad._sessions.setdefault(session.local_index, session)  # the attacker ignores its revocation
        self.assertEqual(carry(), 0)

    def relay(self) -> tuple[Any, Any, list[int]]:
        """Return a relay that finds a session for every node id, its clock, and the list of datagrams that it sends."""
        clock, sent = HeapClock(), [0]

        def send(session: object, plain: bytes) -> None:
            sent[0] += len(plain)

        def session_of(wanted: bytes) -> Any:
            return OneSession(wanted.ljust(32, b"\0"))

        return Relay(session_of, send, clock, Counter()), clock, sent

    def test_quota_of_a_pair(self) -> None:
        """A relay forwards a burst for a pair of peers, and then 64 kbit/s.

        If only one of the two peers sends, the relay stops forwarding after two minutes.
        """
        relay, clock, sent = self.relay()
        session: Any = OneSession(b"a" * 32)
        plain = bytes([RELAY_REQUEST]) + b"b" * 20 + bytes(1000)
        for _ in range(60):
            for _ in range(50):
                relay.on_request(session, plain, VICTIM)
            clock.advance(1.0)
        self.assertLessEqual(sent[0], 1.05 * (PAIR_BURST + 60 * PAIR_RATE))
        self.assertGreater(sent[0], PAIR_BURST)
        clock.advance(90.0)
        before = sent[0]
        relay.on_request(session, plain, VICTIM)
        self.assertEqual(sent[0], before)

    def test_quota_of_all(self) -> None:
        """The total rate of all pairs is limited to ``ALL_RATE``, and the number of pairs to 256."""
        relay, clock, sent = self.relay()
        for _ in range(10):
            for number in range(400):
                session: Any = OneSession(number.to_bytes(32, "big"))
                relay.on_request(session, bytes([RELAY_REQUEST]) + b"b" * 20 + bytes(1300), VICTIM)
            clock.advance(1.0)
        self.assertLessEqual(sent[0], 1.05 * (ALL_BURST + 10 * ALL_RATE))
        self.assertLessEqual(len(relay), MAX_PAIRS)

    def test_no_carrying_in_circles(self) -> None:
        """A relay does not forward datagrams that are relayed already, too long, empty, or addressed to the sender."""
        relay, _, sent = self.relay()
        session: Any = OneSession(b"a" * 32)
        far: Any = OneSession(b"c" * 32, relayed_address(b"d" * 20))
        relay.on_request(far, bytes([RELAY_REQUEST]) + b"b" * 20 + b"x", VICTIM)
        relay.on_request(session, bytes([RELAY_REQUEST]) + b"b" * 20, VICTIM)
        relay.on_request(session, bytes([RELAY_REQUEST]) + b"b" * 20 + bytes(MAX_DATAGRAM_BYTES + 1), VICTIM)
        relay.on_request(session, bytes([RELAY_REQUEST]) + session.contact.node_id + b"x", VICTIM)
        self.assertEqual(sent, [0])
