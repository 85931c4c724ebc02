"""The thread that writes the store's file: nobody waits for it, and nothing is acknowledged before it is written."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable

from twisted.internet.defer import CancelledError
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.data.sqlite import SqliteStore
from tests.middleware.test_store import FOREVER, KEY, record


class SlowDiskTest(SynchronousTestCase):
    def setUp(self) -> None:
        path = self.mktemp()
        self.news: list[Callable[[], None]] = []
        self.store = SqliteStore.open(path, 0.0, deliver=self.news.append)
        self.addCleanup(self.store.close)
        self.store.flush()
        # Whoever holds the file's write lock stalls every commit.
        self.other = sqlite3.connect(path, isolation_level=None)
        self.addCleanup(self.other.close)
        self.other.execute("BEGIN IMMEDIATE")

    def test_nobody_waits_for_a_commit(self) -> None:
        """While a commit stalls all is answered, taken and let go of, but nothing is acknowledged before its end."""
        self.store.put(record("a"), FOREVER)
        first = self.store.written()
        for number in range(500):
            self.store.put(record(str(number), value=None), 5.0)
        self.store.expire(5.0)
        self.store.note("seed", b"seed")
        later = self.store.written()
        self.assertEqual(self.store.get(KEY), [record("a")])
        self.assertNoResult(first)
        self.assertNoResult(later)
        self.other.execute("COMMIT")
        self.store.flush()
        self.successResultOf(first)
        self.successResultOf(later)

    def test_news_are_delivered(self) -> None:
        """An acknowledgement comes in the caller's thread, by way of ``deliver``."""
        self.store.put(record("a"), FOREVER)
        waiting = self.store.written()
        self.other.execute("COMMIT")
        writer = self.store._writer
        with writer._turn:
            self.assertTrue(writer._turn.wait_for(lambda: not writer._owed and not writer._writing, 5.0))
        self.assertNoResult(waiting)
        self.store.close()
        self.successResultOf(waiting)
        self.assertNotEqual(self.news, [])
        for tell in self.news:
            tell()

    def test_who_stops_waiting(self) -> None:
        """Who no longer waits for an acknowledgement does no harm to others that do."""
        self.store.put(record("a"), FOREVER)
        one, other = self.store.written(), self.store.written()
        one.cancel()
        self.failureResultOf(one, CancelledError)
        self.other.execute("COMMIT")
        self.store.flush()
        self.successResultOf(other)
