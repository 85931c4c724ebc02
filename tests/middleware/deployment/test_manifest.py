"""Tests of ``middleware.deployment.manifest``: encoding and precedence of an operator's manifests."""

from __future__ import annotations

import itertools
import random
from dataclasses import replace

import msgpack
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.deployed_modules import STRATEGY
from middleware.deployment.manifest import (
    MAX_PREVIOUS_EDITIONS,
    MAX_VERSION,
    Edition,
    Manifest,
    find_newest,
    make_next_manifest,
    make_rollback,
    manifests_key,
    parse_manifest,
)
from middleware.entangled.identity import Identity
from middleware.entangled.record import Record
from middleware.entangled.value import MAX_VALUE_BYTES

OPERATOR = Identity(bytes([9]) * 32)


def record_of(manifest: Manifest, value: bytes | None = None, name: str | None = None) -> Record:
    content = manifest.pack() if value is None else value
    slot = manifest.name if name is None else name
    return Record(manifests_key(), slot, OPERATOR.public, 1, "team", 60.0, content).sign(OPERATOR)


def versions(n: int) -> list[Manifest]:
    """Return ``n`` successive versions."""
    told: list[Manifest] = []
    for number in range(n):
        told.append(make_next_manifest("best", STRATEGY, b"x = %d" % number, told[-1] if told else None))
    return told


class ManifestTests(SynchronousTestCase):
    def test_survives_the_wire(self) -> None:
        """A packed manifest is unpacked unchanged, with its history, and fits into a record."""
        for manifest in (*versions(9), make_rollback(versions(9)[-1])):
            assert manifest is not None
            self.assertEqual(parse_manifest(record_of(manifest)), manifest)
            self.assertLessEqual(len(manifest.pack()), MAX_VALUE_BYTES)
        self.assertEqual([e.version for e in versions(9)[-1].before], [8, 7, 6, 5])
        self.assertEqual(len(versions(9)[-1].before), MAX_PREVIOUS_EDITIONS)

    def test_newest_word_holds_in_any_order(self) -> None:
        """The last manifest wins, whatever the order in which pushes and rollbacks arrive."""
        first = make_next_manifest("best", STRATEGY, b"1", None)
        second = make_next_manifest("best", STRATEGY, b"2", first)
        back = make_rollback(second)
        assert back is not None
        third = make_next_manifest("best", STRATEGY, b"3", back)
        again = make_rollback(third)
        assert again is not None
        self.assertEqual((back.version, third.version, again.version), (1, 3, 1))
        words = [first, second, back, third, again]
        self.assertEqual(sorted(words, key=lambda m: m.rank), words)
        for order in itertools.permutations(words):
            self.assertEqual(find_newest(order), again)
        self.assertIsNone(make_rollback(again))

    def test_decoder_is_total(self) -> None:
        """No value of a record raises an exception; a value that is not a manifest gives None."""
        good = versions(2)[-1]
        content = msgpack.unpackb(good.pack())
        bad: dict[str, list[object]] = {
            "name": ["Best", "../x", "", 7, "other", "b" * 40],
            "kind": ["module", None, 3],
            "version": [0, -1, 1.0, "2", True, MAX_VERSION + 1],
            "digest": ["ab" * 32, b"", b"a" * 31],
            "size": [-1, None, 2.5],
            "before": [None, [1], [[1, b"x", 3]], [[2, bytes(32), 3]], "x"],
            "withdrawn": [-1, None, MAX_VERSION + 1, True],
        }
        for field, values in bad.items():
            for value in values:
                packed = msgpack.packb({**content, field: value})
                self.assertIsNone(parse_manifest(record_of(good, packed)), f"{field} {value!r}")
        self.assertIsNone(parse_manifest(record_of(good, name="other")))
        self.assertIsNone(parse_manifest(replace(record_of(good), value=None)))
        rng = random.Random(3)
        for _ in range(300):
            crafted = bytearray(good.pack())
            crafted[rng.randrange(len(crafted))] = rng.randrange(256)
            parse_manifest(record_of(good, bytes(crafted)))

    def test_given_version(self) -> None:
        """The caller may choose the version number; the manifest contains the digest of the previous edition."""
        first = make_next_manifest("best", STRATEGY, b"1", None, 4)
        second = make_next_manifest("best", STRATEGY, b"2", first, 9)
        self.assertEqual((first.version, second.version), (4, 9))
        self.assertEqual(second.before, (Edition(4, first.digest, 1),))
