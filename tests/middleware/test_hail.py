"""Tests of HAIL and ECHO: who is there at all."""

from __future__ import annotations

import random

from middleware.entangled.errors import Malformed, NoAnswer, NotRunning
from middleware.entangled.network.network import Address
from middleware.entangled.wire.hail import ECHO, HAIL, VERSION, Echo, Hailer, echo, echo_of, hail
from tests.middleware.gate import Gate
from tests.middleware.test_endpoint import DELAY, EndpointCase

TOKEN = b"0123456789abcdef"
HOME, ELSEWHERE = Address("10.0.0.1", 1), Address("10.0.0.1", 2)


class HailTests(EndpointCase):
    """Behaviour of ``Endpoint.hail`` and of what answers it."""

    def test_who_is_there(self) -> None:
        """An echo, of another team too, has the team's fingerprint, version and clock, and where the hail came from."""
        self.b.echoer.wall = lambda: 1_700_000_000.25
        self.b.echoer._fingerprint = lambda: Gate.fingerprint
        found = self.got(self.a.hail(self.to_b.address), 2 * DELAY)
        self.assertEqual(found[1:], Echo(b"", VERSION, b"the team", 1_700_000_000.25, self.to_a.address)[1:])

        _, to_other = self.endpoint(3, team=b"o" * 32)

        found = self.got(self.a.hail(to_other.address))
        self.assertEqual((found.fingerprint, found.wall), (bytes(8), 0.0))

    def test_nobody_is_there(self) -> None:
        """Where nobody listens the hail fails in time, and one that is cancelled leaves nothing behind."""
        self.failed(self.a.hail(HOME, 1.0), NoAnswer, 1.0)
        self.a.hail(HOME, 1.0).addErrback(lambda failure: None).cancel()
        self.assertEqual(self.a.hailer._pending, {})
        pending = self.a.hail(HOME)
        self.a.stop()
        self.failureResultOf(pending, NotRunning)
        self.failureResultOf(self.a.hail(HOME), NotRunning)

    def test_what_is_none(self) -> None:
        """Hails and echoes of a wrong length or for no question are counted and answered by nothing."""
        receiver = self.taps[self.to_b.address].receiver
        before = self.board.counters["sent"]
        for datagram in (hail(TOKEN)[:-1], hail(TOKEN) + b"x", bytes([HAIL]), bytes([ECHO]) + bytes(7)):
            receiver(datagram, HOME)
        receiver(echo(hail(TOKEN), bytes(8), 0.0, HOME), HOME)
        self.assertEqual(self.b.counters, {"malformed": 4, "unasked": 1})
        self.assertEqual(self.board.counters["sent"], before)
        self.assertRaises(Malformed, echo, b"", bytes(8), 0.0, HOME)
        self.assertRaises(Malformed, echo_of, hail(TOKEN))

    def test_an_echo_from_elsewhere(self) -> None:
        """An echo from another address than was hailed is no answer."""
        sent: list[bytes] = []
        hailer = Hailer(lambda datagram, to: sent.append(datagram), self.clock, random.Random(1))
        asked = hailer.hail(HOME)
        hailer.on_echo(echo(sent[0], bytes(8), 0.0, ELSEWHERE), ELSEWHERE)
        self.assertNoResult(asked)
        hailer.on_echo(echo(sent[0], bytes(8), 0.0, ELSEWHERE), HOME)
        self.assertEqual(self.successResultOf(asked).seen, ELSEWHERE)
