"""Tests of ``middleware.entangled.quorum.acceptor_log`` with the codecs of tuple takes and leases."""

from __future__ import annotations

import msgpack
from hypothesis import given, settings
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.lease.acceptor import may_evict
from middleware.consensus.lease.lease_codec import CODEC, parse_row
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.quorum import acceptor_log as module
from middleware.entangled.quorum.acceptor_log import RegisterLog
from middleware.entangled.quorum.ballot import FIRST_CONFIGURATION, NO_BALLOT, Ballot
from middleware.entangled.quorum.register import Register
from tests.middleware.consensus.lease.test_lease_codec import ANYTHING, MEMBERS


def entered(log: RegisterLog[str], task_id: str, now: float) -> Register | None:
    register = log.make_register(now)
    return register if log.add(task_id, register, now) else None


def granted(log: RegisterLog[str], task_id: str, token: int, now: float, ttl: float = 2.0) -> Register:
    """Return a stored register with a granted lease."""
    register = entered(log, task_id, now)
    assert register is not None
    register.promised = register.holder = Ballot(token, "a")
    register.token, register.ttl, register.lease_until = token, ttl, now + ttl
    log.write(task_id)
    return register


class LogTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.store = MemoryStore()
        self.log = self.opened()

    def opened(self, now: float = 0.0) -> RegisterLog[str]:
        """Open the log on the same store, as a new process does."""
        return RegisterLog(self.store, CODEC, may_evict, now)

    def test_first_life_may_lack_something(self) -> None:
        """If a log finds no stored votes, votes may be lost and the log is not whole; otherwise it is whole."""
        self.assertFalse(self.log.is_complete)
        self.assertTrue(self.opened().is_complete)

    def test_everything_is_back_after_a_restart(self) -> None:
        """Promises, tokens, councils and ends are durable; a restart extends a granted lease by its full TTL."""
        entry = granted(self.log, "t", 7, 0.0)
        entry.accepted, entry.value, entry.released, entry.is_closed = Ballot(9, "b"), MEMBERS[:3], Ballot(1, "c"), True
        self.log.write("t")
        back = self.opened(100.0).get("t")
        assert back is not None
        self.assertEqual(CODEC.pack({"t": back}), CODEC.pack({"t": entry}))
        self.assertEqual(back.lease_until, 102.0)
        entry.holder = NO_BALLOT  # A released lease does not block other proposers.
        self.log.write("t")
        back = self.opened(100.0).get("t")
        self.assertEqual(back and back.lease_until, 0.0)

    def test_longest_ttl_is_remembered(self) -> None:
        """The longest TTL ever granted survives a restart, because a lost lease may last that long."""
        granted(self.log, "t", 1, 0.0, ttl=9.0)
        granted(self.log, "u", 1, 0.0, ttl=2.0)
        self.assertEqual(self.opened().floor.longest, 9.0)

    def test_rotten_notes(self) -> None:
        """If a stored vote is unreadable, the log uses the other votes, and reports that it is not whole."""
        granted(self.log, "t", 7, 0.0)
        for corrupt in (b"\xc1", msgpack.packb([1]), msgpack.packb({"t": [1]}), msgpack.packb({"t": 5})):
            for name in filter(self.store.get_note, CODEC.names):
                self.store.set_note(name, corrupt)
            self.assertFalse(self.opened().is_complete)
        self.store.set_note("lease/state", b"?")
        self.assertFalse(self.opened().is_complete)

    def test_bounded(self) -> None:
        """A full log removes old ended registers, keeps their highest numbers as a bound, and rejects new registers."""
        self.patch(module, "MAX_REGISTERS", 3)
        granted(self.log, "old", 40, 0.0)
        granted(self.log, "done", 30, 0.0).is_closed = True
        granted(self.log, "new", 5, 700.0)
        fresh = entered(self.log, "t", 701.0)
        self.assertIsNotNone(fresh)
        above = self.log.make_register(701.0)
        self.assertEqual((self.log.get("done"), above.token, above.promised.counter), (None, 30, 31))
        self.assertIsNone(entered(self.log, "u", 702.0))
        self.assertEqual(len(self.log), 3)
        late = entered(self.log, "u", 90_000.0)
        self.assertIsNotNone(late)
        self.assertEqual(self.log.make_register(90_000.0).token, 40)
        again = self.opened()
        self.assertEqual(again.floor[:2], (40, 40))

    def test_changed_councils_are_not_forgotten(self) -> None:
        """The register of a council that was replaced is kept while its task is open.

        Without the register the old council could decide again.
        """
        self.patch(module, "MAX_REGISTERS", 1)
        granted(self.log, "t", 1, 0.0).configuration = FIRST_CONFIGURATION + 1
        self.assertIsNone(entered(self.log, "u", 1e9))

    @settings(max_examples=200)
    @given(ANYTHING)
    def test_rows_are_total(self, row: object) -> None:
        """Any row is decoded as a register or as None, without an exception."""
        self.assertIsNone(parse_row(row))
        parse_row([1, row, 1, 1.0, row, False])
        parse_row([row, [0, ""] * 4, row, row, [], row])
