"""Attack S7: cause more work at a node than the attacker has, by floods of handshakes, join requests and probes."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

from twisted.logger import LogLevel

from middleware.admission import certificate, join_codec, server
from middleware.admission.join_code import draw_code
from middleware.admission.membership_list import invitation_id
from middleware.entangled.identity import Identity, derive_exchange_key
from middleware.entangled.network.network import Address
from middleware.entangled.wire import dispatcher
from middleware.entangled.wire import endpoint as wire
from middleware.entangled.wire.discovery import MAX_COOKIE_HANDSHAKES_PER_S, MAX_HANDSHAKES_PER_S
from middleware.entangled.wire.message import Request, encode
from middleware.entangled.wire.probe import PROBE_BYTES, REPLIES_PER_S, pack_probe
from middleware.entangled.wire.session import (
    INIT,
    MAC_BYTES,
    MAX_RESPONSES,
    MAX_UNCONFIRMED,
    Credentials,
    HandshakeFields,
    InitiatorHandshake,
    ResponderHandshake,
)
from tests.attacks.siege import SOURCE, SiegeCase, events_of
from tests.middleware.admission.village import Village, network_of

PER_SECOND = 2000
SECONDS = 3


class FloodCase(SiegeCase):
    """A node of a closed team that is flooded while its expensive operations are counted."""

    def setUp(self) -> None:
        """Count key exchanges, checked signatures, bytes and log lines."""
        super().setUp()
        self.team: Village = self.village()
        self.house = self.team.houses[0]
        port: Any = network_of(self.house)
        self.network = port
        self.exchanges: list[float] = []
        self.checked: list[float] = []
        self.sent: list[tuple[bytes, Address]] = []
        accept, is_proof, send = ResponderHandshake, certificate.is_join_signature, self.network.send

        def accepted(*arguments: Any) -> ResponderHandshake:
            self.exchanges.append(self.team.clock.seconds())
            return accept(*arguments)

        def proved(*arguments: Any) -> bool:
            self.checked.append(self.team.clock.seconds())
            return is_proof(*arguments)

        def sends(datagram: bytes, to: Address) -> None:
            self.sent.append((datagram, to))
            send(datagram, to)

        self.patch(wire, "ResponderHandshake", accepted)
        self.patch(server, "is_join_signature", proved)
        port.send = sends
        self.events = events_of(self)

    @property
    def lines(self) -> list[str]:
        return [str(each.get("log_format")) for each in self.events if each["log_level"] >= LogLevel.info]

    def flood(self, made: Callable[[int], bytes], seconds: int = SECONDS) -> int:
        """Send the datagrams that ``made`` returns from a thousand addresses; return the number of bytes sent."""
        total = 0
        for number in range(PER_SECOND * seconds):
            datagram = made(number)
            total += len(datagram)
            assert self.network.receiver is not None
            self.network.receiver(datagram, Address(f"127.{number % 1000 // 250}.0.{number % 250}", 999))
            if not number % 100:
                self.team.run(100 / PER_SECOND)
        return total

    def answers(self) -> list[bytes]:
        """Return the datagrams that the node sent to the source addresses of the flood."""
        return [datagram for datagram, to in self.sent if to.port == 999]


class FloodTests(FloodCase):
    def test_forged_handshakes(self) -> None:
        """An INIT with a wrong MAC costs the node one hash, but no key exchange, no answer and no state."""
        dice = random.Random(1)
        self.flood(lambda number: bytes([INIT]) + dice.randbytes(1300))
        self.assertEqual((len(self.exchanges), self.lines), (0, []))
        self.assertEqual(self.answers(), [])

    def handshakes(self) -> Callable[[int], bytes]:
        """Return INITs of a malicious member, encrypted with the team's secret and new ephemeral keys."""
        own = Credentials.derive(Identity(b"i" * 32), self.house.team.secret)
        remote, dice = derive_exchange_key(self.house.public), random.Random(2)
        hello = HandshakeFields(max_pass_bytes=640)
        kept: list[bytes] = []

        def made(number: int) -> bytes:
            if len(kept) < 1500:
                kept.append(InitiatorHandshake(own, remote, dice.randbytes(32), number + 1, b"", hello).make_init())
            return kept[number % len(kept)]

        return made

    def test_handshakes_of_a_member(self) -> None:
        """A member that floods a node and ignores its answers causes key exchanges at a limited rate only."""
        received = self.flood(self.handshakes())
        self.assertLessEqual(len(self.exchanges), MAX_HANDSHAKES_PER_S * (SECONDS + 2))
        self.assertLessEqual(sum(map(len, self.answers())), received)
        half = self.house.node.endpoint._half_open
        self.assertLessEqual(len(half._responses), MAX_RESPONSES)
        self.assertLessEqual(len(half._unconfirmed), MAX_UNCONFIRMED)
        self.assertGreater(self.house.node.endpoint.counters["crowded"], PER_SECOND / 2)
        self.assertLess(len(self.lines), 5)
        self.assertLess(MAX_HANDSHAKES_PER_S, MAX_COOKIE_HANDSHAKES_PER_S)

    def test_others_still_come_in(self) -> None:
        """During a flood a member that returns the cookie can open a session; this takes one additional round trip."""
        made = self.handshakes()
        self.flood(made, 1)
        friend, _ = self.insider(self.team, "friend")
        asked = friend.ask(self.team.contact(self.house), "ping", bytes(8), changes=True)
        self.flood(made, 1)
        self.assertEqual(len(self.successResultOf(asked)), 8)

    def test_knocks(self) -> None:
        """A join request without an invitation costs one table lookup.

        Few such requests are answered, and few lines are logged.
        """
        dice = random.Random(3)
        received = self.flood(
            lambda number: bytes([join_codec.JOIN_REQUEST]) + dice.randbytes(join_codec.JOIN_REQUEST_BYTES - 1)
        )
        answers = self.answers()
        self.assertLessEqual(len(answers), server.MAX_UNSIGNED_REFUSALS_PER_S * (SECONDS + 1))
        self.assertLessEqual(sum(map(len, answers)), received)
        self.assertEqual((self.checked, len(self.exchanges)), ([], 0))
        self.assertLessEqual(len(self.lines), 20 + SECONDS)

    def test_knocks_of_who_knows_the_id(self) -> None:
        """An undecryptable join request with the id of a real invitation costs no signature check."""
        code = self.team.invite("dog")
        [invite] = self.team.houses[0].team.membership_list.list_invitations()
        self.assertTrue(code)
        dice = random.Random(4)
        head = bytes([join_codec.JOIN_REQUEST]) + invitation_id(invite.public)
        self.flood(lambda number: head + dice.randbytes(join_codec.JOIN_REQUEST_BYTES - len(head)), 1)
        self.assertEqual(self.checked, [])
        self.assertEqual(self.answers(), [])

    def test_knocks_of_who_has_the_code(self) -> None:
        """Join requests with a real code, each with a different key, cause signature checks at a limited rate only."""
        code, packed, terms = self.team.signer.invite("pig", ("device",), 1, self.team.wall(), 900.0, random.Random(5))
        self.team.tell(terms)
        self.team.tell(packed)
        self.team.run(1.0)
        dice = random.Random(6)
        kept = [
            join_codec.make_request(code.key, Identity(dice.randbytes(32)).public, dice.randbytes(32), "", dice)
            for _ in range(400)
        ]
        received = self.flood(lambda number: kept[number % 400], 2)
        self.assertLessEqual(len(self.checked), server.MAX_REQUESTS_PER_S * 4)
        self.assertLessEqual(sum(map(len, self.answers())), received)
        self.team.run(3.0)
        self.assertEqual(len(self.team.members()), 2)
        self.assertNotEqual(draw_code(self.team.signer.public, dice).text, code.text)

    def test_hails(self) -> None:
        """At most twenty PROBE datagrams per second are answered, each with a reply of the same length."""
        self.flood(lambda number: pack_probe(number.to_bytes(16, "little")))
        answers = self.answers()
        self.assertLessEqual(len(answers), REPLIES_PER_S * (SECONDS + 1))
        self.assertLessEqual({len(datagram) for datagram in answers}, {PROBE_BYTES})

    def test_questions_of_a_member(self) -> None:
        """A member's requests are executed at a limited rate; requests beyond the limit are rejected with "busy"."""
        bad, _ = self.insider(self.team, "bad")
        contact = self.team.contact(self.house)
        self.outcome(self.team, bad.ask(contact, "ping", bytes(8), changes=True))
        ran: list[float] = []
        self.house.node.endpoint.expose("device.settings", lambda peer: ran.append(self.team.clock.seconds()))
        session = next(iter(bad._sessions.values()))
        began = self.team.clock.seconds()
        for number in range(15_000):
            plain = encode(Request(number, "device.settings", ()))
            assert self.network.receiver is not None
            self.network.receiver(session.seal(plain), SOURCE)
            if not number % 1000:
                self.team.run(0.1)
        seconds = self.team.clock.seconds() - began
        self.assertLessEqual(len(ran), dispatcher.REQUEST_BURST + dispatcher.REQUESTS_PER_S * seconds)
        self.assertGreater(len(ran), dispatcher.REQUEST_BURST)
        self.assertGreater(self.house.node.endpoint.counters["busy"], 2000)
        refused = self.outcome(self.team, bad.ask(contact, "device.settings"), 0.01)
        self.assertEqual(getattr(refused, "code", ""), "busy")
        friend, _ = self.insider(self.team, "friend", at=SOURCE._replace(port=667))
        self.outcome(self.team, friend.ask(contact, "device.settings"))
        self.assertEqual(ran[-1], max(ran))
        self.team.run(10.0)
        self.outcome(self.team, bad.ask(contact, "device.settings"))
        self.assertGreater(ran[-1], began + seconds + 5.0)

    def test_a_cookie_of_another(self) -> None:
        """A cookie is valid only for the address to which it was sent."""
        made = self.handshakes()
        self.flood(made, 1)
        self.assertEqual(made(1)[-MAC_BYTES:], bytes(MAC_BYTES))
        cookies = self.house.node.endpoint._cookies
        here, there = Address("127.0.0.1", 1), Address("127.0.0.1", 2)
        paid = InitiatorHandshake(
            Credentials.derive(Identity(b"i" * 32), self.house.team.secret),
            derive_exchange_key(self.house.public),
            bytes(31) + b"\x01",
            7,
            b"",
            HandshakeFields(max_pass_bytes=640),
        ).make_init(cookies._make_cookie(here, int(self.team.clock.seconds() / 120)))
        now = self.team.clock.seconds()
        self.assertTrue(cookies.is_valid(paid, here, now))
        self.assertFalse(cookies.is_valid(paid, there, now))
