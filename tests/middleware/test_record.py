"""Tests of records: conflict resolution, signatures and decoding."""

from __future__ import annotations

from dataclasses import replace

import msgpack
from hypothesis import given
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled import record as records
from middleware.entangled.record import (
    MAX_NAME_BYTES,
    MAX_TTL_S,
    MAX_VALUE_BYTES,
    Record,
    SignatureCache,
    hash_key,
    parse_record,
    parse_slot,
)
from tests.middleware.test_store import CAT, DOG, KEY, record

ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


class RecordTest(SynchronousTestCase):
    def test_which_holds(self) -> None:
        """The record with the higher sequence wins; if sequences are equal, all replicas choose the same record."""
        one, other = record(value=b"1"), record(value=b"2")
        self.assertTrue(record(sequence=2).supersedes(one))
        self.assertFalse(one.supersedes(record(sequence=2)))
        self.assertNotEqual(one.supersedes(other), other.supersedes(one))
        self.assertFalse(one.supersedes(one))
        self.assertTrue(one.supersedes(None))

    def test_signature_covers_all(self) -> None:
        """The signature of a record is invalid if any field was changed after signing."""
        self.assertTrue(record().is_genuine())
        changes: list[dict[str, object]] = [
            {"key": hash_key("tasks")},
            {"name": "else"},
            {"owner": CAT.public},
            {"sequence": 2},
            {"lifetime": "leased"},
            {"ttl": 61.0},
            {"value": b"there"},
            {"value": None},
            {"signature": bytes(64)},
            {"signature": b""},
        ]
        for change in changes:
            self.assertFalse(replace(record(), **change).is_genuine(), change)  # type: ignore[arg-type]

    def test_good_signatures_are_remembered(self) -> None:
        """A valid signature is verified only once; a changed record is verified separately."""
        signed = SignatureCache()
        self.assertTrue(signed.is_genuine(record()))
        for change in ({"value": b"there"}, {"sequence": 2}, {"signature": bytes(64)}, {"owner": CAT.public}):
            self.assertFalse(signed.is_genuine(replace(record(), **change)), change)
        self.assertEqual(len(signed), 1)
        self.patch(records, "is_signature_valid", lambda *_: self.fail("checked twice"))
        self.assertTrue(signed.is_genuine(replace(record())))

    def test_remembered_signatures_are_bounded(self) -> None:
        """The cache of valid signatures is bounded and keeps the most recently used ones."""
        self.patch(records, "MAX_CACHED", 3)
        signed = SignatureCache()
        for sequence in (1, 2, 3, 1, 4):
            self.assertTrue(signed.is_genuine(record(sequence=sequence)))
        self.patch(records, "is_signature_valid", lambda *_: False)
        self.assertEqual([n for n in range(1, 5) if signed.is_genuine(record(sequence=n))], [1, 3, 4])

    def test_there_and_back(self) -> None:
        """A record survives packing and unpacking."""
        for one in (record(), record(value=None, lifetime="leased"), record("", value=bytes(MAX_VALUE_BYTES))):
            self.assertEqual(parse_record(msgpack.unpackb(msgpack.packb(one.pack()))), one)

    def test_message_bytes(self) -> None:
        """``message_bytes`` is an upper bound of the packed size, and exceeds it by less than 40 bytes."""
        for one in (record(), record(value=None), record("ä" * 64, sequence=2**63 - 1), record(value=bytes(20_000))):
            taken = len(msgpack.packb(one.pack()))
            self.assertTrue(taken <= one.message_bytes < taken + 40, (taken, one.message_bytes))

    def test_limits(self) -> None:
        """A field that is out of range or of a wrong type makes the record invalid."""
        bad: dict[int, list[object]] = {
            0: [KEY[:-1], KEY + b"\0", "key", None],
            1: ["n" * (MAX_NAME_BYTES + 1), b"name", None],
            2: [DOG.public[:-1], DOG.public + b"\0", "owner"],
            3: [-1, 2**63, 1.0, True, None],
            4: ["forever", "", None, []],
            5: [0.0, -1.0, MAX_TTL_S + 1.0, float("nan"), float("inf"), 60, None],
            6: [bytes(MAX_VALUE_BYTES + 1), "value", 1],
            7: [bytes(63), bytes(65), None, "s" * 64],
        }
        for place, values in bad.items():
            for value in values:
                fields = record().pack()
                fields[place] = value
                self.assertIsNone(parse_record(fields), (place, value))
        others: list[object] = [record().pack()[:-1], [*record().pack(), 1], tuple(record().pack()), None, {}]
        for other in others:
            self.assertIsNone(parse_record(other))

    @given(ANYTHING | st.lists(ANYTHING, min_size=8, max_size=8))
    def test_total(self, fields: object) -> None:
        """Any input is decoded as a record or as None, without an exception."""
        self.assertTrue(parse_record(fields) is None or isinstance(parse_record(fields), Record))

    def test_slots(self) -> None:
        """A slot survives packing as a list; anything except a list of key, owner and name is rejected."""
        self.assertEqual(parse_slot(list(record().slot)), record().slot)
        wrong: list[object] = [
            [],
            [KEY, DOG.public],
            [KEY, DOG.public, b"a"],
            [KEY, 1, "a"],
            tuple(record().slot),
            None,
        ]
        for fields in wrong:
            self.assertIsNone(parse_slot(fields), fields)

    def test_keys_of_texts(self) -> None:
        """The key of a text has 160 bits, is the same on every node, and differs from the keys of other texts."""
        self.assertEqual(hash_key("devices").hex(), "880ce22f2953aafc3ac777bc4930bb783fb05bfa")
        self.assertNotEqual(hash_key("devices"), hash_key("device"))
