"""Tests of the exchange before the handshake: cookies under load, and probes."""

from __future__ import annotations

import random

from middleware.entangled.errors import Malformed, NoAnswer, NotRunning
from middleware.entangled.identity import Identity, derive_exchange_key
from middleware.entangled.network.network import Address
from middleware.entangled.wire.discovery import (
    COOKIE,
    COOKIE_BYTES,
    MAX_COOKIE_HANDSHAKES_PER_S,
    MAX_HANDSHAKES_PER_S,
    CookieCheck,
)
from middleware.entangled.wire.probe import (
    PROBE,
    PROBE_REPLY,
    VERSION,
    Prober,
    ProbeReply,
    pack_probe,
    pack_reply,
    parse_reply,
)
from middleware.entangled.wire.session import MIN_INIT_BYTES, RESP, Credentials, InitiatorHandshake
from tests.middleware.gate import Gate
from tests.middleware.test_endpoint import DELAY, TEAM, EndpointCase

HOME, ELSEWHERE = Address("10.0.0.1", 1), Address("10.0.0.1", 2)


class CookieTests(EndpointCase):
    """Tests of ``CookieCheck`` and of endpoints under a flood."""

    def invitation(self, number: int, cookie: bytes = b"") -> bytes:
        """Return an INIT datagram of a member."""
        own = Credentials.derive(Identity(b"m" * 32), TEAM)
        ephemeral = (number << 64).to_bytes(32, "big")
        return InitiatorHandshake(own, derive_exchange_key(self.to_b.public), ephemeral, number, b"").make_init(cookie)

    def flood(self, count: int) -> list[bytes]:
        """Send ``count`` INITs to ``b`` from one address and return its replies."""
        answers: list[bytes] = []
        deaf = self.switchboard.make_network("10.0.0.1", 1)
        deaf.listen(lambda datagram, source: answers.append(datagram))
        for number in range(count):
            self.taps[self.to_b.address].receiver(self.invitation(number), HOME)
        self.clock.advance(DELAY)
        deaf.close()
        return answers

    def test_above_the_rate_comes_a_cookie(self) -> None:
        """Up to the rate limit an INIT gets a RESP, above the limit a cookie, which creates no session."""
        answers = self.flood(300)
        kinds = [answer[0] for answer in answers]
        self.assertEqual(kinds, [RESP] * int(MAX_HANDSHAKES_PER_S) + [COOKIE] * (300 - int(MAX_HANDSHAKES_PER_S)))
        self.assertEqual(len(self.b._sessions), int(MAX_HANDSHAKES_PER_S))
        self.assertTrue(all(len(answer) <= MIN_INIT_BYTES for answer in answers))
        self.assertEqual({len(answer) for answer in answers if answer[0] == COOKIE}, {COOKIE_BYTES})

    def test_a_cookie_is_bound_to_its_address_and_time(self) -> None:
        """A cookie is valid only for its address and for at most four minutes; the rate of handshakes is limited."""
        cookies = CookieCheck(b"c" * 32, random.Random(1))
        cookie = cookies._make_cookie(HOME, int(1000 / 120))
        paid = self.invitation(1, cookie)
        self.assertTrue(cookies.is_valid(paid, HOME, 1000.0))
        self.assertTrue(cookies.is_valid(paid, HOME, 1100.0))
        self.assertFalse(cookies.is_valid(paid, HOME, 1400.0))
        self.assertFalse(cookies.is_valid(paid, ELSEWHERE, 1000.0))
        self.assertTrue(cookies.is_valid(self.invitation(1), ELSEWHERE, 1000.0))
        admitted = sum(cookies.admits(paid, HOME, 1000.0) for _ in range(2 * int(MAX_COOKIE_HANDSHAKES_PER_S)))
        self.assertEqual(admitted, int(MAX_COOKIE_HANDSHAKES_PER_S))

    def test_forged_cookies(self) -> None:
        """A COOKIE from another address, for an unknown INIT or with a wrong tag is counted and has no effect."""
        self.b._cookies._limit._tokens = -1e6
        self.a.ask(self.to_b, "echo", 7).addErrback(lambda failure: None)
        self.clock.advance(1.5 * DELAY)
        tap = self.taps[self.to_a.address]
        genuine, tap.receiver = tap.receiver, lambda datagram, source: None
        self.clock.advance(DELAY)
        cookie, source = self.kept(self.to_a, COOKIE)[0]
        genuine(cookie, ELSEWHERE)
        genuine(cookie[:-1] + bytes([cookie[-1] ^ 1]), source)
        genuine(cookie[:-1], source)
        genuine(cookie[:1] + bytes(16) + cookie[17:], source)
        counted = [self.a.counters[name] for name in ("misdirected", "forged", "stale")]
        self.assertEqual(counted, [1, 2, 1])
        self.assertEqual(next(iter(self.a._peers._handshakes.values())).cookies, {self.to_b.address: b""})


TOKEN = b"0123456789abcdef"


class ProbeTests(EndpointCase):
    """Tests of ``Endpoint.probe`` and of the replies to probes."""

    def test_who_is_there(self) -> None:
        """A reply, also of another team, contains fingerprint, version and clock, and the address of the requester."""
        self.b.probe_responder.unix_time = lambda: 1_700_000_000.25
        self.b.probe_responder._fingerprint = lambda: Gate.fingerprint
        found = self.got(self.a.probe(self.to_b.address), 2 * DELAY)
        self.assertEqual(found[1:], ProbeReply(b"", VERSION, b"the team", 1_700_000_000.25, self.to_a.address)[1:])

        _, to_other = self.endpoint(3, team=b"o" * 32)

        found = self.got(self.a.probe(to_other.address))
        self.assertEqual((found.fingerprint, found.unix_time_s), (bytes(8), 0.0))

    def test_nobody_is_there(self) -> None:
        """A probe without a reply fails after its timeout; a cancelled probe leaves no state."""
        self.failed(self.a.probe(HOME, 1.0), NoAnswer, 1.0)
        self.a.probe(HOME, 1.0).addErrback(lambda failure: None).cancel()
        self.assertEqual(self.a.prober._pending, {})
        pending = self.a.probe(HOME)
        self.a.stop()
        self.failureResultOf(pending, NotRunning)
        self.failureResultOf(self.a.probe(HOME), NotRunning)

    def test_what_is_none(self) -> None:
        """Probes of wrong length, replies of wrong length and unsolicited replies are counted and not answered."""
        receiver = self.taps[self.to_b.address].receiver
        before = self.switchboard.counters["sent"]
        for datagram in (
            pack_probe(TOKEN)[:-1],
            pack_probe(TOKEN) + b"x",
            bytes([PROBE]),
            bytes([PROBE_REPLY]) + bytes(7),
        ):
            receiver(datagram, HOME)
        receiver(pack_reply(pack_probe(TOKEN), bytes(8), 0.0, HOME), HOME)
        self.assertEqual(self.b.counters, {"malformed": 4, "unasked": 1})
        self.assertEqual(self.switchboard.counters["sent"], before)
        self.assertRaises(Malformed, pack_reply, b"", bytes(8), 0.0, HOME)
        self.assertRaises(Malformed, parse_reply, pack_probe(TOKEN))

    def test_an_echo_from_elsewhere(self) -> None:
        """A reply from an address other than the probed address is ignored."""
        sent: list[bytes] = []
        prober = Prober(lambda datagram, to: sent.append(datagram), self.clock, random.Random(1))
        asked = prober.probe(HOME)
        prober.on_reply(pack_reply(sent[0], bytes(8), 0.0, ELSEWHERE), ELSEWHERE)
        self.assertNoResult(asked)
        prober.on_reply(pack_reply(sent[0], bytes(8), 0.0, ELSEWHERE), HOME)
        self.assertEqual(self.successResultOf(asked).observed_address, ELSEWHERE)
