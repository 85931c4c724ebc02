"""The contract of all data stores, and tests of the store in memory."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.data.store import MAX_BYTES, Store, count_bytes
from middleware.entangled.errors import OWNER_FULL, Full, Refused
from middleware.entangled.identity import Identity
from middleware.entangled.record import Lifetime, Record, Slot, hash_key

if TYPE_CHECKING:
    _Case = SynchronousTestCase
else:
    _Case = object

DOG = Identity(b"\1" * 32)
CAT = Identity(b"\2" * 32)
KEY = hash_key("devices")
FOREVER = 1e9


def record(
    name: str = "state",
    sequence: int = 1,
    value: bytes | None = b"here",
    owner: Identity = DOG,
    key: bytes = KEY,
    lifetime: Lifetime = "team",
) -> Record:
    return Record(key, name, owner.public, sequence, lifetime, 60.0, value).sign(owner)


class StoreContract(_Case):
    """The contract of every store; a test case inherits it and creates the store."""

    store: Store

    def make(self, max_rows: int, max_bytes: int = MAX_BYTES, hold: float = 30.0) -> Store:
        """Create an empty store with these limits; the test case closes it."""
        raise NotImplementedError

    def settle(self, store: Store) -> None:
        """Wait until the store has written its changes."""

    def setUp(self) -> None:
        self.store = self.make(100)

    def test_empty(self) -> None:
        """A new store is empty, and reports that it is new."""
        self.assertEqual((self.store.origin, self.store.corrupt_rows, len(self.store.epoch)), ("new", 0, 8))
        self.assertEqual(len(self.store), 0)
        self.assertEqual(self.store.get(KEY), [])
        self.assertIsNone(self.store.get_slot(Slot(KEY, DOG.public, "state")))
        self.assertEqual(self.store.find_owned(DOG.public), [])
        self.assertEqual(self.store.extend_leases(DOG.public, FOREVER), 0)
        self.assertEqual(self.store.expire(FOREVER), [])
        self.assertEqual(self.store.drop_leased(DOG.public), [])
        self.assertEqual(self.store.records(), [])
        self.assertIsNone(self.store.get_note("seed"))

    def test_order_of_a_key(self) -> None:
        """The records of a key are sorted by owner and name."""
        records = [record("b", owner=CAT), record("a"), record("c", owner=CAT), record("b")]
        for one in records:
            self.store.put(one, FOREVER)
        self.assertEqual(self.store.get(KEY), sorted(records, key=lambda r: (r.owner, r.name)))
        self.assertEqual(self.store.records(), records)
        self.assertEqual(self.store.find_owned(DOG.public), [record("a"), record("b")])

    def test_put_and_remove(self) -> None:
        """A record is found by its key and slot; a tombstone hides it from readers and wins over older records.

        If a caller changes a returned list, the store does not change.
        """
        self.assertTrue(self.store.put(record(), FOREVER))
        self.store.get(KEY, tombstones=True).clear()
        self.store.get(KEY).clear()
        self.assertEqual(self.store.get(KEY), [record()])
        self.assertEqual(self.store.get(hash_key("tasks")), [])
        gone = record(sequence=2, value=None)
        self.assertTrue(self.store.put(gone, FOREVER))
        self.assertEqual(self.store.get(KEY), [])
        self.assertEqual(self.store.get(KEY, tombstones=True), [gone])
        self.assertEqual(self.store.get_slot(gone.slot), gone)
        self.assertFalse(self.store.put(record(), FOREVER))

    def test_loser_extends_nothing(self) -> None:
        """A record that loses against the stored record does not extend the TTL of the stored record."""
        self.store.put(record(sequence=2), 1.0)
        self.store.put(record(sequence=1), 5.0)
        self.store.put(replace(record(sequence=2), value=b"else"), 5.0)
        self.assertEqual(self.store.expire(1.0), [record(sequence=2)])

    def test_goodbye(self) -> None:
        """A goodbye removes the leased records of the owner and keeps its team records."""
        leased = [record(name, lifetime="leased") for name in "ba"]
        for one in (*leased, record("c"), record("a", owner=CAT, lifetime="leased")):
            self.store.put(one, FOREVER)
        self.assertEqual(self.store.drop_leased(DOG.public), [leased[1], leased[0]])
        self.assertEqual(len(self.store), 2)
        self.assertEqual(self.store.get(KEY), sorted(self.store.records(), key=lambda r: r.owner))
        self.assertEqual(self.store.drop_leased(DOG.public), [])

    def test_full(self) -> None:
        """A full store rejects new slots, but accepts new records for existing slots.

        After records expired it accepts new slots.
        """
        store = self.make(2)
        store.put(record("a"), 1.0)
        store.put(record("b"), FOREVER)
        line = str(self.assertRaises(Full, store.put, record("c"), FOREVER))
        self.assertIn(f"store full: it holds 2 of 2 rows, {store.usage.bytes} of {MAX_BYTES} bytes", line)
        self.assertTrue(store.put(record("b", sequence=2), FOREVER))
        self.assertFalse(store.put(record("a"), 2.0))
        store.expire(2.0)
        self.assertTrue(store.put(record("c"), FOREVER))

    def test_delete_always_fits(self) -> None:
        """A full store accepts a limited number of tombstones, even for new slots."""
        store = self.make(1)
        store.put(record("a"), FOREVER)
        self.assertTrue(store.put(record("b", value=None), FOREVER))
        self.assertRaises(Refused, store.put, record("c", value=None), FOREVER)
        self.assertTrue(store.put(record("a", sequence=2, value=None), FOREVER))

    def test_bytes_are_counted(self) -> None:
        """The byte count is the sum of the field sizes of all stored records, after any changes."""
        self.assertEqual(self.store.usage, (0, 100, 0, MAX_BYTES))
        held = [record("a", value=bytes(1000)), record("ä" * 3, value=None), record("c", value=b"", owner=CAT)]
        for one in held:
            self.store.put(one, FOREVER)
        self.assertEqual(count_bytes(held[0]), 20 + 32 + 1 + 1000 + 64 + 17)
        self.assertEqual(count_bytes(held[1]), 20 + 32 + 6 + 64 + 17)
        self.assertEqual(self.store.usage.bytes, sum(map(count_bytes, held)))
        self.store.put(record("a", 2, value=b"1"), FOREVER)
        self.assertEqual(self.store.usage.bytes, sum(map(count_bytes, held)) - 999)
        self.store.put(record("d"), FOREVER)
        self.store.discard(record("d").slot)
        self.store.expire(FOREVER)
        self.assertEqual(self.store.usage[::2], (0, 0))

    def test_full_of_bytes(self) -> None:
        """The byte quota is exact for new records and records that grow; a record that shrinks is always accepted."""
        small, large = record("b", value=b""), record("a", value=bytes(500))
        store = self.make(100, count_bytes(large) + count_bytes(small))
        store.put(large, FOREVER)
        self.assertRaises(Full, store.put, record("b", value=b"1"), FOREVER)
        self.assertTrue(store.put(small, FOREVER))
        self.assertRaises(Full, store.put, record("b", 2, value=b"1"), FOREVER)
        self.assertTrue(store.put(record("b", 2, value=b""), FOREVER))
        self.assertTrue(store.put(record("a", 2, value=bytes(499)), FOREVER))
        self.assertTrue(store.put(record("b", 3, value=b"1"), FOREVER))
        self.assertRaises(Full, store.put, record("c", value=bytes(600)), FOREVER)

    def test_one_owner_leaves_as_much_as_it_has(self) -> None:
        """An owner may use half of the free rows and bytes, and always a small minimum of them."""
        for rows, octets, value in ((1000, MAX_BYTES, b""), (10_000, 1_000_000, bytes(10_000))):
            store = self.make(rows, octets)
            shares = [self.fill(store, owner, value) for owner in (DOG, CAT)]
            self.assertEqual(shares, [500, 250] if rows == 1000 else [49, 24])
            self.assertEqual(self.assertRaises(Full, store.put, record("x", value=value), FOREVER).code, OWNER_FULL)
            self.assertTrue(store.put(record("x", value=value, owner=Identity(b"n" * 32)), FOREVER))
            self.assertTrue(store.put(record("0", sequence=2, value=None), FOREVER))
            self.assertTrue(store.put(record("1", sequence=2, value=b""), FOREVER))

    def test_room_of_an_owner_comes_back(self) -> None:
        """Tombstones count for their owner.

        If an owner's new records need space, only its own old tombstones are evicted.
        """
        store = self.make(1000, hold=30.0)
        store.put(record("old", value=None, owner=CAT), 60.0)
        for number in range(499):
            store.put(record(str(number), value=None), 60.0)
        self.assertRaises(Full, store.put, record("x"), FOREVER)
        store.expire(31.0)
        self.assertTrue(store.put(record("x"), FOREVER))
        self.assertIsNone(store.get_slot(record("0").slot))
        self.assertIsNotNone(store.get_slot(record("old", owner=CAT).slot))
        store.discard(record("x").slot)
        self.assertTrue(store.put(record("y"), FOREVER))

    def fill(self, store: Store, owner: Identity, value: bytes) -> int:
        """Put records of an owner until a record is rejected; return the number of accepted records."""
        for number in range(100_000):
            try:
                store.put(replace(record("", value=value), name=str(number), owner=owner.public), FOREVER)
            except Full:
                return number
        return -1

    def test_order_of_eviction(self) -> None:
        """Old tombstones are evicted first, the oldest first; other records are not evicted."""
        store = self.make(3, hold=30.0)
        old, older = record("old", value=None), record("older", value=None)
        store.put(older, 60.0)
        store.put(old, 61.0)
        store.put(record("kept"), FOREVER)
        self.assertRaises(Refused, self.make(0).put, record(), FOREVER)
        gone: list[str] = []
        names = {r.name for r in (older, old, record("kept"))}
        store.expire(31.0)
        for number in range(2):
            store.put(record(f"new{number}"), FOREVER)
            left = {name for name in names if store.get_slot(Slot(KEY, DOG.public, name)) is not None}
            gone += sorted(names - left)
            names = left
        self.assertEqual(gone, ["older", "old"])
        self.assertRaises(Full, store.put, record("new2"), FOREVER)
        self.assertEqual([r.name for r in store.records()], ["kept", "new0", "new1"])
        self.assertEqual(store.expire(31.0), [older, old])

    def test_young_tombstones_stay(self) -> None:
        """A tombstone younger than the hold time is not evicted."""
        store = self.make(1, hold=30.0)
        store.put(record("a", value=None), 60.0)
        store.expire(29.9)
        self.assertRaises(Full, store.put, record("b"), FOREVER)
        store.expire(30.0)
        self.assertTrue(store.put(record("b"), FOREVER))

    def test_refusal_changes_nothing(self) -> None:
        """If eviction would not free enough space, nothing is evicted."""
        store = self.make(100, 3 * count_bytes(record("a")))
        store.put(record("a"), FOREVER)
        store.put(record("b", value=None), 60.0)
        before = store.usage
        store.expire(59.0)
        self.assertRaises(Full, store.put, record("c", value=bytes(400)), FOREVER)
        grown = record("b", 2, value=bytes(count_bytes(record("a")) + 5))  # one byte too large
        self.assertRaises(Full, store.put, grown, FOREVER)
        self.assertEqual(store.usage, before)
        self.assertEqual(store.get_slot(record("b").slot), record("b", value=None))

    def test_written(self) -> None:
        """A put is acknowledged after the write, or immediately if no write is pending."""
        self.store.put(record(), FOREVER)
        acknowledged = self.store.wait_for_write()
        self.settle(self.store)
        self.successResultOf(acknowledged)
        self.successResultOf(self.store.wait_for_write())
        self.assertEqual(self.store.write_error, "")

    def test_notes(self) -> None:
        """The last value of a note is returned; a store can be closed twice."""
        for value in (b"one", b"two", b"two"):
            self.store.set_note("seed", value)
        self.store.set_note("contacts", b"")
        for _ in range(2):
            self.assertEqual((self.store.get_note("seed"), self.store.get_note("contacts")), (b"two", b""))
            self.store.close()


class MemoryStoreTest(StoreContract, SynchronousTestCase):
    def make(self, max_rows: int, max_bytes: int = MAX_BYTES, hold: float = 30.0) -> Store:
        return MemoryStore(max_rows, max_bytes, hold)

    def test_expiries_do_not_pile_up(self) -> None:
        """The size of the heap of expiry times stays proportional to the number of stored records."""
        store = MemoryStore()
        for sequence in range(1, 1001):
            store.put(record(sequence=sequence), FOREVER - sequence)
            store.put(record("lease", sequence, lifetime="leased"), FOREVER)
            store.drop_leased(DOG.public)
        self.assertLess(len(store._heap), 80)
        self.assertEqual(store.expire(FOREVER), [record(sequence=1000)])

    @settings(max_examples=100)
    @given(st.lists(st.tuples(st.sampled_from("ppedxg"), st.integers(0, 3), st.integers(1, 4), st.integers(0, 30))))
    def test_like_the_obvious_one(self, events: list[tuple[str, int, int, int]]) -> None:
        """Any sequence of puts, extensions, goodbyes and sweeps gives the same result as a plain dictionary."""
        store, plain = MemoryStore(), dict[Slot, tuple[Record, float]]()
        for verb, number, sequence, moment in events:
            lifetime: Lifetime = "leased" if number % 2 else "team"
            one = Record(KEY, str(number), DOG.public, sequence, lifetime, 60.0, b"", bytes(64))
            leased = {slot: held for slot, held in plain.items() if held[0].lifetime == "leased"}
            if verb == "p":
                old = plain.get(one.slot)
                self.assertEqual(store.put(one, moment), old is None or sequence > old[0].sequence)
                if old is None or sequence > old[0].sequence:
                    plain[one.slot] = (one, moment)
                elif old[0] == one:
                    plain[one.slot] = (one, max(old[1], moment))
            elif verb == "e":
                self.assertEqual(store.extend_leases(DOG.public, moment), len(leased))
                plain |= {slot: (held, max(until, moment)) for slot, (held, until) in leased.items()}
            elif verb == "g":
                self.assertEqual([r.slot for r in store.drop_leased(DOG.public)], sorted(leased))
                plain = {slot: held for slot, held in plain.items() if slot not in leased}
            elif verb == "x":
                self.assertEqual(store.discard(one.slot), plain.pop(one.slot, None) is not None)
            else:
                gone = sorted((until, slot) for slot, (_, until) in plain.items() if until <= moment)
                self.assertEqual([r.slot for r in store.expire(moment)], [slot for _, slot in gone])
                for _, slot in gone:
                    del plain[slot]
            self.assertEqual(store.get(KEY), [plain[slot][0] for slot in sorted(plain)])
            self.assertEqual(len(store), len(plain))
            self.assertEqual(store.usage.bytes, sum(count_bytes(held) for held, _ in plain.values()))

    @settings(max_examples=60)
    @given(
        st.lists(
            st.tuples(st.integers(0, 9), st.integers(1, 5), st.none() | st.integers(0, 300), st.integers(0, 99)),
            max_size=60,
        )
    )
    def test_quotas_hold(self, puts: list[tuple[int, int, int | None, int]]) -> None:
        """For any sequence of puts the quotas hold, the byte count is exact, and only tombstones are evicted."""
        store, now = MemoryStore(5, 1200, hold=20.0), 0.0
        for number, sequence, size, step in puts:
            now += step / 10
            value = None if size is None else bytes(size)
            one = Record(KEY, str(number), DOG.public, sequence, "team", 60.0, value, bytes(64))
            store.expire(now)
            before = {r.slot: r for r in store.records() if r.value is not None}
            try:
                store.put(one, now + 60.0)
            except Full:
                self.assertEqual({r.slot: r for r in store.records() if r.value is not None}, before)
            gone = {r.slot for r in store.expire(now)}
            held = {r.slot: r for r in store.records()}
            self.assertEqual({slot for slot in before if slot not in held} - gone, set())
            everything = store.get(KEY, tombstones=True)
            self.assertEqual(store.usage.bytes, sum(map(count_bytes, everything)))
            self.assertLessEqual(sum(r.value is not None for r in everything), 5)
            self.assertLessEqual(sum(count_bytes(r) for r in everything if r.value is not None), 1200)
            self.assertLessEqual(len(everything), 10)
