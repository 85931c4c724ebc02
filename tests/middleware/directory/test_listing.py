"""Tests of a listing of the directory: it contains each device once, and reports prefixes that it could not read."""

from __future__ import annotations

import random
from collections.abc import Mapping

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.directory.listing import Listing, select_listed
from middleware.directory.prefix import ROOT, compute_places, compute_prefix
from middleware.directory.presence import DEVICES, MAX_DEPTH, Device
from middleware.entangled.identity import derive_node_id
from middleware.entangled.record import Record

Places = dict[bytes, list[Record]]


def owners(count: int, seed: int = 1) -> list[bytes]:
    dice = random.Random(seed)
    return [dice.randbytes(32) for _ in range(count)]


def record(key: bytes, owner: bytes, depth: int, sequence: int = 1) -> Record:
    """Return the record that a device at ``depth`` writes under ``key``."""
    value = Device(derive_node_id(owner).hex(), "d", depth=depth).pack()
    return Record(key, "d", owner, sequence, "leased", 1.0, value, bytes(64))


def announced(depths: Mapping[bytes, int]) -> Places:
    """Return the records under each key, for devices that announce themselves at the depths in ``depths``."""
    places: Places = {}
    for owner, depth in depths.items():
        for key in compute_places(derive_node_id(owner), depth):
            places.setdefault(key, []).append(record(key, owner, depth))
    return places


def listed(places: Places, listing: Listing, silent: frozenset[bytes] = frozenset()) -> Listing:
    """Run ``listing`` to its end; reads of the keys in ``silent`` fail."""
    seen: list[bytes] = []
    while (place := listing.take_next()) is not None:
        seen.append(place.key)
        if place.key in silent:
            listing.on_failure(place)
        else:
            listing.add_records(place, places.get(place.key, []))
    assert len(set(seen)) == len(seen), "a place was read twice"
    return listing


class ListingTests(SynchronousTestCase):
    def test_everybody_once(self) -> None:
        """Every device is listed once, with one read per prefix, whatever depth the reader assumes at first."""
        depths = dict.fromkeys(owners(600), 5)
        for floor in (0, 3, 5):
            listing = listed(announced(depths), Listing(floor))
            self.assertEqual([r.owner for r in listing.records], sorted(depths))
            self.assertEqual(listing.reads, 32)
            self.assertTrue(listing.is_complete)
        listing = listed(announced(dict.fromkeys(owners(20), 0)), Listing())
        self.assertEqual((listing.reads, len(listing.records), listing.is_complete), (1, 20, True))

    @settings(max_examples=60, deadline=None)
    @given(st.integers(2, 6), st.integers(0, 2**32))
    def test_neighbours_disagree(self, depth: int, seed: int) -> None:
        """All devices are found if each device is randomly at one of two adjacent depths."""
        dice = random.Random(seed)
        depths = {owner: depth + dice.randint(0, 1) for owner in owners(24 << depth, seed)}
        listing = listed(announced(depths), Listing(max(0, depth - 1)))
        self.assertEqual(len(listing.records), len(depths))

    def test_one_that_is_ahead_or_behind(self) -> None:
        """A single device that is one depth below all others, or at any depth above them, is found."""
        team = owners(400)
        for odd in team[:40]:
            for depth in (5, 3, 1, 0):
                depths = {**dict.fromkeys(team, 4), odd: depth}
                self.assertEqual(len(listed(announced(depths), Listing(3)).records), len(team), depth)

    def test_two_networks_become_one(self) -> None:
        """After a partition into 20 and 600 devices all are found, although the 20 are under the root key only."""
        depths = {**dict.fromkeys(owners(600), 5), **dict.fromkeys(owners(20, 2), 0)}
        for floor in (0, 4):
            self.assertEqual(len(listed(announced(depths), Listing(floor)).records), 620)

    def test_some_know_sooner_that_the_team_is_small(self) -> None:
        """If most of 40 devices have returned to the root key, devices at up to two depths below are still listed."""
        team = owners(40)
        for deep in (1, 2):
            depths = {owner: deep if derive_node_id(owner)[0] >> 7 != DEVICES[0] >> 7 else 0 for owner in team}
            self.assertEqual(len(listed(announced(depths), Listing()).records), 40, deep)

    def test_a_place_that_does_not_answer(self) -> None:
        """A prefix that cannot be read makes the listing incomplete, and the listing reports this prefix."""
        depths = dict.fromkeys(owners(600), 5)
        lost = compute_prefix(derive_node_id(next(iter(depths))), 5)
        listing = listed(announced(depths), Listing(), frozenset([lost.key]))
        self.assertFalse(listing.is_complete)
        (missed,) = listing.missed
        self.assertTrue(missed.has(lost.first))
        self.assertEqual(missed.key, lost.key)
        absent = set(depths) - {r.owner for r in listing.records}
        self.assertTrue(absent and all(missed.has(derive_node_id(owner)) for owner in absent))

    def test_wrong_places(self) -> None:
        """A device under a prefix that does not match its id is not listed, and causes no further reads."""
        team, liars = owners(20), owners(200, 9)
        places = announced(dict.fromkeys(team, 0))
        places[DEVICES] += [record(DEVICES, liar, 9) for liar in liars]
        told = [liar for liar in liars if DEVICES in compute_places(derive_node_id(liar), 9)]
        self.assertLess(len(told), 5)
        listing = listed(places, Listing())
        self.assertEqual({r.owner for r in listing.records}, {*team, *told})
        if not told:
            self.assertEqual(listing.reads, 1)
        for strange in (-1, MAX_DEPTH + 1, 1.0, "1", True):
            crafted = record(DEVICES, team[0], strange)  # type: ignore[arg-type]
            self.assertEqual(select_listed(DEVICES, [crafted]), [], strange)

    def test_a_liar_costs_little(self) -> None:
        """A device that states the maximum depth causes a reader at most one additional read per depth."""
        seed = next(s for s in range(10**6) if DEVICES[:2] == derive_node_id(owners(1, s)[0])[:2])
        (liar,) = owners(1, seed)
        places = announced({**dict.fromkeys(owners(20), 0), liar: MAX_DEPTH})
        listing = listed(places, Listing())
        self.assertEqual((len(listing.records), listing.reads), (21, 1 + MAX_DEPTH))

    def test_only_below_a_prefix(self) -> None:
        """A listing of one prefix reads only the keys below it."""
        depths = dict.fromkeys(owners(600), 5)
        under = compute_prefix(derive_node_id(next(iter(depths))), 3)
        listing = listed(announced(depths), Listing(5, under))
        self.assertEqual(listing.reads, 4)
        self.assertLessEqual({o for o in depths if under.has(derive_node_id(o))}, {r.owner for r in listing.records})

    def test_what_is_open_is_not_over(self) -> None:
        """While the answer to a read is pending, the listing is neither over nor complete."""
        listing = Listing(1)
        self.assertFalse(listing.is_over)
        self.assertEqual(listing.take_next(), ROOT)
        self.assertIsNone(listing.take_next())
        self.assertFalse(listing.is_over)
        listing.add_records(ROOT, [])
        second = listing.take_next()
        assert second is not None
        self.assertFalse(listing.is_complete)
        listing.add_records(second, [])
        self.assertTrue(listing.is_complete)
