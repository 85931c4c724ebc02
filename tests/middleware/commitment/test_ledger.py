"""Tests of ``middleware.commitment.ledger``."""

from __future__ import annotations

import random

import msgpack
from hypothesis import given, settings
from twisted.trial.unittest import SynchronousTestCase

from middleware.commitment import ledger as module
from middleware.commitment.ballot import FIRST, NONE, Ballot
from middleware.commitment.ledger import Entry, Ledger, entry_of
from middleware.entangled.data.memory import MemoryStore
from tests.middleware.commitment.test_ballot import ANYTHING, MEMBERS


def granted(ledger: Ledger, task_id: str, token: int, now: float, ttl: float = 2.0) -> Entry:
    """An entry with a lease in it, kept."""
    entry = ledger.add(task_id, FIRST, now)
    assert entry is not None
    entry.promised = entry.ballot = Ballot(token, "a")
    entry.token, entry.ttl, entry.until = token, ttl, now + ttl
    ledger.keep(task_id)
    return entry


class LedgerTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.store = MemoryStore()
        self.ledger = Ledger(self.store)

    def test_first_life_may_lack_something(self) -> None:
        """Who finds nothing may have lost it, and is not whole; whoever finds what it kept is."""
        self.assertFalse(self.ledger.is_whole)
        self.assertTrue(Ledger(self.store).is_whole)
        self.assertFalse(Ledger().is_whole)

    def test_everything_is_back_after_a_restart(self) -> None:
        """Promises, tokens, councils and ends are kept; what was leased is leased for as long again."""
        entry = granted(self.ledger, "t", 7, 0.0)
        entry.sealed, entry.members, entry.spent, entry.is_over = Ballot(9, "b"), MEMBERS[:3], Ballot(1, "c"), True
        self.ledger.keep("t")
        back = Ledger(self.store, 100.0).get("t")
        assert back is not None
        self.assertEqual(back.packed(), entry.packed())
        self.assertEqual(back.until, 102.0)

    def test_released_lease_is_not_leased_again(self) -> None:
        """What was given back before the restart holds nobody up after it."""
        entry = granted(self.ledger, "t", 7, 0.0)
        entry.ballot = NONE
        self.ledger.keep("t")
        back = Ledger(self.store, 100.0).get("t")
        assert back is not None
        self.assertEqual(back.until, 0.0)

    def test_longest_ttl_is_remembered(self) -> None:
        """The longest lease ever granted is known after a restart: so long may others rely on what was forgotten."""
        granted(self.ledger, "t", 1, 0.0, ttl=9.0)
        granted(self.ledger, "u", 1, 0.0, ttl=2.0)
        self.assertEqual(Ledger(self.store).longest, 9.0)

    def test_rotten_notes(self) -> None:
        """Where a note cannot be read the rest is used, and the ledger knows that something is missing."""
        granted(self.ledger, "t", 7, 0.0)
        for rotten in (b"\xc1", msgpack.packb([1]), msgpack.packb({"t": [1]}), msgpack.packb({"t": 5})):
            for number in range(module.BUCKETS):
                if self.store.noted(f"lease/{number}"):
                    self.store.note(f"lease/{number}", rotten)
            self.assertFalse(Ledger(self.store).is_whole)
        self.store.note("lease/state", b"?")
        self.assertFalse(Ledger(self.store).is_whole)

    def test_bounded(self) -> None:
        """A full ledger forgets what is long over, keeps a floor under its numbers, and else takes no more."""
        self.patch(module, "MAX_TASKS", 3)
        granted(self.ledger, "old", 40, 0.0)
        granted(self.ledger, "done", 30, 0.0).is_over = True
        granted(self.ledger, "new", 5, 700.0)
        fresh = self.ledger.add("t", FIRST, 701.0)
        assert fresh is not None
        self.assertEqual((self.ledger.get("done"), fresh.token, fresh.promised.counter), (None, 30, 30))
        self.assertIsNone(self.ledger.add("u", FIRST, 702.0))
        self.assertEqual(len(self.ledger), 3)
        late = self.ledger.add("u", FIRST, 90_000.0)
        assert late is not None
        self.assertEqual(late.token, 40)
        again = Ledger(self.store)
        self.assertEqual((again.floor.counter, again.token), (40, 40))

    def test_changed_councils_are_not_forgotten(self) -> None:
        """That a council was changed is known for as long as its task is open: an old council must not rise again."""
        self.patch(module, "MAX_TASKS", 1)
        granted(self.ledger, "t", 1, 0.0).configuration = 2
        self.assertIsNone(self.ledger.add("u", FIRST, 1e9))

    def test_many_tasks(self) -> None:
        """Hundreds of tasks are all back after a restart, whatever their names."""
        names = [f"{random.Random(n).randbytes(4).hex()} ü" for n in range(300)]
        for number, name in enumerate(names, start=1):
            granted(self.ledger, name, number, 0.0)
        back = Ledger(self.store)
        tokens = [entry.token for name in names if (entry := back.get(name)) is not None]
        self.assertEqual(tokens, list(range(1, 301)))

    @settings(max_examples=200, deadline=None, derandomize=True, database=None)
    @given(ANYTHING)
    def test_rows_are_total(self, row: object) -> None:
        """Whatever stands in a row is an entry or none, and never an accident."""
        self.assertIsNone(entry_of(row))
        entry_of([1, row, 1, 1.0, row, False])
        entry_of([row, [0, ""] * 4, row, row, [], row])
