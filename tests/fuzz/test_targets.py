"""Tests of the fuzz targets with a limited number of inputs from hypothesis."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from tests.fuzz import envelope, handshake, raw
from tests.fuzz.ground import Ground, Violation

BOUNDED = settings(max_examples=150)


class TargetTests(SynchronousTestCase):
    """No input violates a rule: a rejected input changes nothing, and no reply is larger than its request."""

    @BOUNDED
    @given(st.binary(max_size=1500))
    def test_any_datagram(self, data: bytes) -> None:
        """Arbitrary datagrams of a node outside the team violate no rule."""
        raw.check(b"\0" + data)

    @BOUNDED
    @given(st.integers(0, 30), st.lists(st.tuples(st.integers(0, 1400), st.integers(1, 255)), max_size=4))
    def test_any_change(self, which: int, changes: list[tuple[int, int]]) -> None:
        """Recorded datagrams, unchanged and with a few changed bytes, violate no rule."""
        raw.check(bytes([raw.RECORDED + which]) + b"".join(w.to_bytes(2, "little") + bytes([b]) for w, b in changes))

    @BOUNDED
    @given(st.binary(max_size=1371))
    def test_any_plaintext(self, data: bytes) -> None:
        """Arbitrary plaintexts, encrypted in a member's session, violate no rule."""
        envelope.check(len(data).to_bytes(2, "little") + data)

    def test_the_ground_notices(self) -> None:
        """The hash covers new sessions, timers and pending calls; a reply longer than its request is a violation."""
        ground = Ground()
        self.addCleanup(ground.stop)
        before = ground.state()
        self.assertEqual(ground.state(), before)
        ground.clock.callLater(1.0, lambda: None)
        timed = ground.state()
        self.assertNotEqual(timed, before)
        ground.target.ask(ground.contact, "echo", 1).addErrback(lambda failure: None)
        self.assertNotEqual(ground.state(), timed)
        ground.node.put(bytes(20), "n", b"v").addErrback(lambda failure: None)
        before = ground.state()
        ground.shoot(handshake.init(ground, b"\x80" + bytes(6)))
        self.assertNotEqual(ground.state(), before)
        send = ground.network.send
        ground.target.discoverer.on_discovery = lambda datagram, source: send(bytes(500), source)  # type: ignore[method-assign]
        ground.target._receivers[0x14] = ground.target.discoverer.on_discovery
        who = next(number for number, one in enumerate(ground.recorded) if one[0] == 0x14)
        ground.known = ""
        self.assertRaises(Violation, raw.shot, ground, bytes([raw.RECORDED + who]))
