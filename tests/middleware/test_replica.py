"""Tests of a single replica, which stores records for other nodes."""

from __future__ import annotations

import random
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.background import Background
from middleware.entangled.clock import HeapClock
from middleware.entangled.contact import Contact
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.errors import Refused, Unwritable
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import Switchboard
from middleware.entangled.record import Lifetime, Record, hash_key, parse_record
from middleware.entangled.replication.pusher import WATCH_TTL_S
from middleware.entangled.replication.replica import PAGE_BYTES, SWEEP_INTERVAL_S, SYNCED_REPLY, Replica, split_pages
from middleware.entangled.replication.store_reply import MAX_SEQUENCE, Outcome, StoreReply, decode_reply
from middleware.entangled.replication.watch import digest_of
from middleware.entangled.wire.endpoint import Endpoint

DOG, CAT, ME = (Identity(bytes([n]) * 32) for n in (1, 2, 3))
KEY = hash_key("devices")
TEAM = b"t" * 32


def record(
    name: str = "state",
    sequence: int = 1,
    value: bytes | None = b"v",
    owner: Identity = DOG,
    lifetime: Lifetime = "team",
) -> Record:
    return Record(KEY, name, owner.public, sequence, lifetime, 1.0, value).sign(owner)


class Alone:
    """The overlay of a node that knows no other node."""

    is_responsible = staticmethod(lambda key: True)
    find_nearest = staticmethod(lambda target: list[Contact]())
    process_message = remove = staticmethod(lambda contact: None)


class ReplicaTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock = HeapClock()
        self.switchboard = Switchboard(self.clock, random.Random(1))
        self.store = MemoryStore(50)
        self.background = Background(self.clock)
        self.endpoint = self.opened(ME, 1)
        overlay: Any = Alone()
        self.replica = Replica(self.store, self.endpoint, overlay, self.clock, self.background)
        self.replica.start()
        self.told: list[tuple[object, ...]] = []
        self.replica.on_record.add(lambda r: self.told.append(("record", r.name)))
        self.replica.on_gone.add(lambda r: self.told.append(("gone", r.name)))
        self.replica.on_owner_expired.add(lambda owner: self.told.append(("silent", owner)))
        self.dog = Contact(DOG.public, Address("10.0.0.1", 2))
        self.cat = Contact(CAT.public, Address("10.0.0.1", 3))
        self.heard: list[tuple[object, ...]] = []
        self.watcher = self.opened(CAT, 3)
        self.watcher.expose("push", lambda peer, *arguments: self.heard.append(arguments), changes=True)
        self.owner = self.opened(DOG, 2)
        self.owner.expose("missing", lambda peer, marks: self.heard.append(("missing", marks)))

    def opened(self, identity: Identity, port: int) -> Endpoint:
        network = self.switchboard.make_network("10.0.0.1", port)
        endpoint = Endpoint(identity, TEAM, network, self.clock, random.Random(port))
        endpoint.start()
        return endpoint

    def tearDown(self) -> None:
        self.background.stop()
        for endpoint in (self.endpoint, self.watcher, self.owner):
            endpoint.stop()

    def stored(self, *records: Record, peer: Contact | None = None) -> list[int]:
        answers = self.replica.answer_store(peer or self.dog, [r.pack() for r in records])
        assert isinstance(answers, list)
        return answers

    def test_the_stronger_record_is_kept(self) -> None:
        """A newer and a repeated record are accepted; an older record is rejected with the current sequence number."""
        self.assertEqual(self.stored(record(sequence=5)), [0])
        self.assertEqual(self.stored(record(sequence=5)), [0])
        self.assertEqual(self.stored(record(sequence=4)), [5])
        self.assertEqual(self.stored(record(sequence=6)), [0])
        weaker, stronger = sorted([record("x", value=b"a"), record("x", value=b"b")], key=lambda r: r.signature)
        self.assertEqual(self.stored(stronger), [0])
        self.assertEqual(self.stored(weaker), [1])

    def test_holds(self) -> None:
        """``holds`` is true only for the stored record, not for an older record, a cached copy or a watched copy."""
        self.stored(record(sequence=5))
        self.assertTrue(self.replica.holds(record(sequence=5)))
        self.assertFalse(self.replica.holds(record(sequence=4)))
        self.replica.cache.put(KEY, [record("cached")], 60.0, 0.0)
        self.assertFalse(self.replica.holds(record("cached")))
        self.replica.watched_copies.replace(KEY, [record("kept")], 0.0)
        self.assertIsNotNone(self.store.get_slot(record("kept").slot))
        self.assertFalse(self.replica.holds(record("kept")))
        self.assertEqual([held.name for held in self.replica.get_held(KEY)], [record(sequence=5).name])

    def test_who_may_store(self) -> None:
        """A leased record is accepted only from its owner; a record from another node needs a valid signature."""
        forged = Record(KEY, "f", DOG.public, 1, "team", 1.0, b"v", bytes(64))
        self.assertEqual(self.stored(record(lifetime="leased"), record("t"), forged, peer=self.cat), [-1, 0, -1])
        self.assertEqual(self.stored(record(lifetime="leased"), forged), [0, 0])

    def test_acknowledged_once_written(self) -> None:
        """A store request is answered after the record is written; if this fails, it is rejected with the reason."""
        writing: list[Deferred[None]] = []
        self.store.wait_for_write = lambda: writing.append(Deferred()) or writing[-1]  # type: ignore[method-assign,func-returns-value]
        peer = Contact(ME.public, Address("10.0.0.1", 1))
        for name in ("a", "b"):
            answer = self.owner.ask(peer, "store", [record(name).pack()], changes=True)
            self.clock.advance(0.01)
            self.assertNoResult(answer)
            self.assertEqual(len(self.store.get(KEY)), len(writing))
            if name == "a":
                writing[-1].callback(None)
                self.clock.advance(0.01)
                self.assertEqual(self.successResultOf(answer), [0])
            else:
                writing[-1].errback(Unwritable("the disk is full"))
                self.clock.advance(0.01)
                self.assertIn("the disk is full", str(self.failureResultOf(answer, Refused).value))

    def test_lease_runs_out(self) -> None:
        """A leased record expires one TTL after its last renewal.

        The owner is marked as silent only when a lease ends.
        """
        self.stored(record(lifetime="leased"), record("t"))
        self.clock.advance(0.8)
        self.replica.answer_alive(self.dog, 1.0, digest_of([record(lifetime="leased")]))
        self.clock.advance(0.3)
        self.assertEqual(self.told, [("record", "state"), ("record", "t"), ("gone", "t")])
        self.clock.advance(0.7 + SWEEP_INTERVAL_S)
        self.assertEqual(self.told[3:], [("gone", "state"), ("silent", DOG.public)])

    def test_strange_leases(self) -> None:
        """The duration of a lease is limited, and an invalid duration in a renewal has no effect."""
        self.stored(record(lifetime="leased"))
        for lease in (float("nan"), -5.0, 5, float("inf")):
            self.replica.answer_alive(self.dog, lease, b"")
        self.clock.advance(3590.0)
        self.assertEqual(len(self.store.get(KEY)), 1)
        self.clock.advance(20.0)
        self.assertEqual(self.store.get(KEY), [])

    def test_goodbye(self) -> None:
        """A goodbye ends the leases and watches of its sender; the team records of the sender stay."""
        self.stored(record(lifetime="leased"), record("t"))
        self.replica.answer_goodbye(self.dog)
        self.assertEqual([r.name for r in self.store.get(KEY)], ["t"])
        self.assertEqual(self.told[2:], [("gone", "state"), ("silent", DOG.public)])

    def test_missing(self) -> None:
        """If the owner's digest differs, the owner gets the list of held leases after its second renewal.

        If all its leases have expired, it gets the list immediately.
        """
        held = record(lifetime="leased")
        self.stored(held)
        for told in ([], [("missing", [digest_of([held])])]):
            self.replica.answer_alive(self.dog, 1.0, b"other")
            self.clock.advance(0.1)
            self.assertEqual(self.heard, told)
        self.clock.advance(60.0)
        self.assertEqual(self.store.get(KEY), [])
        self.replica.answer_alive(self.dog, 1.0, b"other")
        self.clock.advance(0.1)
        self.assertEqual(self.heard[1:], [("missing", [])])

    def test_let_go(self) -> None:
        """Only the owner can make a replica drop a leased record; a team record is not dropped."""
        held, team = record(lifetime="leased"), record("t")
        self.stored(held, team)
        marks: list[object] = [digest_of([held]), digest_of([team]), 5, None]
        self.replica.answer_let_go(self.cat, marks)
        self.assertEqual(len(self.store.get(KEY)), 2)
        self.replica.answer_let_go(self.dog, marks)
        self.assertEqual(self.store.get(KEY), [team])
        self.assertEqual(self.told[2:], [("gone", "state")])

    def test_pages(self) -> None:
        """A key with many records is read in pages with each record once, including tombstones."""
        records = [record(f"{n:02}", value=None if n % 3 else b"v" * 2000) for n in range(30)]
        for one in records:
            self.stored(one)
        seen: list[object] = []
        page: list[Any] = self.replica.answer_find_value(self.dog, KEY)
        pages = 1
        while page[1] is not None:
            seen += page[0]
            page = self.replica.answer_find_value(self.dog, KEY, page[1])
            pages += 1
        seen += page[0]
        self.assertEqual([parse_record(fields) for fields in seen], records)
        self.assertGreaterEqual(pages, 2)

    def test_pages_are_full(self) -> None:
        """Each page is filled up to its size limit; an oversized record gets a separate page."""
        records = [record(f"{n}", value=b"v" * 1500) for n in range(30)]
        pages = list(split_pages(records))
        self.assertEqual([one for page in pages for one in page], records)
        self.assertGreater(len(pages), 3)
        self.assertEqual({len(page) for page in pages[:-1]}, {PAGE_BYTES // records[0].message_bytes})
        large = record("large", value=b"v" * (PAGE_BYTES + 1))
        self.assertEqual([len(page) for page in split_pages([large, *records[:2], large, *records[:2]])], [1, 2, 1, 2])
        self.assertEqual([len(page) for page in split_pages(records[:5], 2)], [2, 2, 1])
        self.assertEqual(list(split_pages([])), [])

    def test_bad_cursors_and_keys(self) -> None:
        """An invalid cursor, and a key of the wrong length, are rejected."""
        self.stored(record())
        for after in ([], [1, 2], ["x", "y"], [b"x"], [b"x", "y", 1]):
            self.assertRaises(Refused, self.replica.answer_find_value, self.dog, KEY, after)
        self.assertRaises(Refused, self.replica.answer_find_value, self.dog, b"short")
        self.assertRaises(Refused, self.replica.answer_watch, self.dog, b"short", b"")
        self.assertEqual(self.replica.answer_find_value(self.dog, KEY, [b"\xff" * 32, ""]), [[], None, SYNCED_REPLY])

    def test_watch(self) -> None:
        """A watcher with an old digest gets the first page, and then each change until its watch expires."""
        self.stored(record())
        page = self.replica.answer_watch(self.cat, KEY, b"")
        self.assertEqual(page, [0, [[record().pack()], None]])
        self.assertEqual(self.replica.answer_watch(self.cat, KEY, digest_of([record()])), [0, None])
        self.stored(record(sequence=2))
        self.clock.advance(0.5)
        self.assertEqual(self.heard, [(KEY, 1, [record(sequence=2).pack()], [])])
        self.clock.advance(0.6)
        self.assertEqual(self.heard[1:], [(KEY, 2, [], [[DOG.public, "state"]])])
        self.clock.advance(2 * WATCH_TTL_S)
        self.stored(record(sequence=3))
        self.clock.advance(0.5)
        self.assertEqual(len(self.heard), 2)
        self.assertEqual(self.replica.pusher._watchers, {})

    def test_too_many_watchers(self) -> None:
        """The number of watchers is bounded, and an existing watcher can renew its watch."""
        peers = [Contact(bytes([n % 256, n >> 8] * 16), Address("10.0.0.9", 1 + n)) for n in range(1001)]
        for peer in peers[:1000]:
            self.replica.answer_watch(peer, KEY, b"")
        self.assertRaises(Refused, self.replica.answer_watch, peers[1000], KEY, b"")
        self.replica.answer_watch(peers[0], KEY, b"")


RECORD = Record(bytes(20), "x", bytes(32), 7, "team", 60.0, b"\xc0", bytes(64))


class StoreReplyTests(SynchronousTestCase):
    def test_round_trip(self) -> None:
        """Each reply survives encoding and decoding, with the codes of the protocol."""
        replies = [StoreReply(each) for each in Outcome if each is not Outcome.SUPERSEDED]
        for reply in [*replies, StoreReply(Outcome.SUPERSEDED, 7), StoreReply(Outcome.SUPERSEDED, MAX_SEQUENCE - 1)]:
            self.assertEqual(decode_reply(reply.encode(), RECORD), reply)
        self.assertEqual([reply.encode() for reply in replies], [0, -1, -2, -3, -4])

    @given(st.integers() | st.booleans() | st.none() | st.floats() | st.text() | st.binary())
    def test_total(self, foreign: Any) -> None:
        """Any other reply is decoded as None, such as one with a lower sequence than the record's."""
        reply = decode_reply(foreign, RECORD)
        is_valid = type(foreign) is int and (-4 <= foreign <= 0 or 7 <= foreign < MAX_SEQUENCE)
        self.assertEqual(reply is not None, is_valid)
