"""Tests of what is remembered of refusals."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.wire.rebuff import HOUR, MAX_REBUFFS, Rebuffs


class RebuffTests(SynchronousTestCase):
    """Behaviour of ``Rebuffs``."""

    def setUp(self) -> None:
        self.rebuffs = Rebuffs()

    def met(self, who: bytes, now: float, code: str = "revoked") -> None:
        """Somebody is not let in."""
        self.rebuffs.met(who, "10.0.0.1:7000", "we", code, "why; what to do", now)

    def test_count_what_happens_again(self) -> None:
        """The same refusal of the same key is one, with its first and last moment; another code is another one."""
        for now in (1.0, 2.0, 5.0):
            self.met(b"a", now)
        self.met(b"a", 6.0, "expired")
        found = [(each.code, each.first_at, each.last_at, each.count) for each in self.rebuffs.newest(6.0)]
        self.assertEqual(found, [("expired", 6.0, 6.0, 1), ("revoked", 1.0, 5.0, 3)])

    def test_forget_after_an_hour(self) -> None:
        """What is longer ago than an hour is not told, and counts from one again."""
        self.met(b"a", 0.0)
        self.assertEqual(self.rebuffs.newest(HOUR + 1.0), [])
        self.met(b"a", HOUR + 1.0)
        self.assertEqual([each.count for each in self.rebuffs.newest(HOUR + 1.0)], [1])

    def test_invented_keys_take_no_room(self) -> None:
        """However many keys somebody invents, only the newest few are remembered."""
        for number in range(10 * MAX_REBUFFS):
            self.met(number.to_bytes(32), float(number))
        self.assertEqual((len(self.rebuffs), self.rebuffs.newest(700.0)[0].last_at), (MAX_REBUFFS, 639.0))
