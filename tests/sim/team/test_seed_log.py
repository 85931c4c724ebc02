"""Tests of the seed log of long runs: its entries, and the seeds that remain to be run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from middleware.errors import BadSetting
from sim.team.seed_log import SeedRun, append_entry, find_missing, parse_entries, split_ranges

ENTRY = SeedRun("2026-11-22T10:00:00Z", "abc", "", 1, 3, (2,), 1.5)


class SeedLogTests(SynchronousTestCase):
    def book(self) -> Path:
        """Return the path of a new seed log."""
        return Path(self.mktemp())

    def test_what_is_added_is_read(self) -> None:
        """Entries are read in the order in which they were appended."""
        book, second = self.book(), replace(ENTRY, first=4, failures=())
        for entry in (ENTRY, second):
            append_entry(str(book), entry)
        self.assertEqual(parse_entries(book.read_text(), "book"), [ENTRY, second])

    def test_half_a_line(self) -> None:
        """An incomplete last line is ignored when the seed log is read, and removed when an entry is appended."""
        book = self.book()
        append_entry(str(book), ENTRY)
        with book.open("a") as torn:
            torn.write(ENTRY.to_json()[:20])
        self.assertEqual(parse_entries(book.read_text(), "book"), [ENTRY])
        append_entry(str(book), ENTRY)
        self.assertEqual(parse_entries(book.read_text(), "book"), [ENTRY, ENTRY])

    def test_no_seed_log(self) -> None:
        """A complete line that is not a valid entry is rejected; the error contains the line number."""
        told = ENTRY.to_json() + "\nhello\n" + ENTRY.to_json() + "\n"
        error = self.assertRaises(BadSetting, parse_entries, told, "book")
        self.assertIn("line 2", str(error))

    def test_missing(self) -> None:
        """A seed in the seed log is run again only if the workloads differ from those of its entry."""
        logged = [ENTRY, replace(ENTRY, first=6), replace(ENTRY, first=4, what="wire")]
        self.assertEqual(find_missing(range(1, 11), logged, ""), [4, 5, 9, 10])

    def test_stretches(self) -> None:
        """Consecutive seeds are grouped into ranges of limited length."""
        self.assertEqual(split_ranges([1, 2, 3, 7, 8, 10], 2), [[1, 2], [3], [7, 8], [10]])
        self.assertEqual(split_ranges([], 2), [])
