"""Tests of the hand-over of large records: page after page, never more on its way than there is room for."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.handover import MENDED_AT_ONCE, PAGE_BYTES, _pages
from middleware.entangled.record import Record, hashed_key
from middleware.entangled.wire.courier import MAX_OUT_OF_PEER
from tests.fleet import FleetCase

KEY = hashed_key("large")


def records(*sizes: int) -> list[Record]:
    """Records with values of these sizes."""
    return [Record(KEY, f"{n}", bytes(32), 1, "team", 1.0, bytes(size)) for n, size in enumerate(sizes)]


class PageTests(SynchronousTestCase):
    """How records are cut into pages."""

    def test_pages_by_bytes(self) -> None:
        """Pages keep the order, hold no more than their bytes and number, and a larger value goes alone."""
        given = records(10, 2**20, 10, PAGE_BYTES - 10, 1, *([1] * 50))
        pages = list(_pages(given))
        self.assertEqual([one for page in pages for one in page], given)
        self.assertEqual([len(page) for page in pages], [1, 1, 2, MENDED_AT_ONCE, MENDED_AT_ONCE, 11])
        self.assertEqual(list(_pages([])), [])


class LargeHandoverTests(FleetCase):
    """Newcomers and large records."""

    def test_a_newcomer_gets_more_than_fits_at_once(self) -> None:
        """A newcomer is given all of 12 MiB, though no more than 8 may be on its way to it at a time."""
        fleet = self.fleet(3)
        dice = random.Random(1)
        sizes = [2**20] * 12
        self.assertGreater(sum(sizes), MAX_OUT_OF_PEER)
        for number, size in enumerate(sizes):
            self.done(fleet, fleet.nodes[2].put(KEY, f"{number:02}", dice.randbytes(size)))
        fleet.nodes[2].vanish()
        fleet.run(5.0)
        newcomer = fleet.add()
        fleet.run(10.0)
        self.assertEqual(len(newcomer.store.get(KEY)), len(sizes))
        self.assertEqual(newcomer.endpoint.counters["crowded"], 0)
