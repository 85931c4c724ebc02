"""Tests of the acceptors of tuple takes, of stored tuples, and of the completion of unfinished takes."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.internet.defer import Deferred, fail, maybeDeferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.background import Background
from middleware.entangled.clock import HeapClock
from middleware.entangled.contact import Contact
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.errors import NoAnswer, Refused
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.quorum import acceptor_log as module
from middleware.entangled.quorum.acceptor import Event
from middleware.entangled.quorum.ballot import Ballot
from middleware.entangled.quorum.register import ReplyKind
from middleware.entangled.record import Record
from middleware.entangled.space.take_acceptor import MAX_TUPLES, TakeAcceptor
from middleware.entangled.space.take_codec import CODEC, unpack_reply
from middleware.entangled.space.take_proposer import TakeProposer
from middleware.entangled.space.tuple_record import (
    Member,
    RecordParser,
    StoredTuple,
    TakenNote,
    TupleId,
    pack_taken,
    pack_tuple,
    parse_record,
    parse_records,
    parse_tuple_id,
)

ME = Identity(b"m" * 32)
PEER = Contact(ME.public, Address("10.0.0.1", 1))
KEY = b"k" * 20
FOREIGN: Any = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4) | st.binary(max_size=33),
    lambda inner: st.lists(inner, max_size=6),
    max_leaves=12,
)


def place(number: int, name: str = "t") -> TupleId:
    return TupleId(KEY, ME.public, f"{name}{number}", number.to_bytes(8, "big"))


def record(name: str, value: bytes | None, sequence: int = 1) -> Record:
    return Record(KEY, name, ME.public, sequence, "team", 60.0, value, bytes([sequence]) * 64)


def tuple_record(where: TupleId, sequence: int = 1) -> Record:
    return record(where.name, pack_tuple(where.mark, ("x",), [Member(PEER, b"i" * 8)]), sequence)


class Exposed:
    def __init__(self) -> None:
        self.methods: dict[str, Callable[..., object]] = {}

    def expose(self, name: str, answer: Callable[..., object], changes: bool = False) -> None:
        self.methods[name] = answer


class TakeAcceptorTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock = HeapClock()
        self.store = MemoryStore()
        self.acceptor = self.made()

    def made(self, seed: int = 1) -> TakeAcceptor:
        """Create the member again with the same store, as after a restart."""
        return TakeAcceptor(Exposed(), self.store, self.clock, random.Random(seed))

    def claim(self, where: TupleId, counter: int = 1, taker: bytes = b"a", lease: float = 2.0) -> ReplyKind:
        answer: Any = self.acceptor.answer_claim(
            PEER, KEY, [where.pack()], self.acceptor.incarnation, counter, taker, lease
        )
        return self._kind(answer, Event.PREPARE)

    def confirm(self, where: TupleId, counter: int = 1, taker: bytes = b"a") -> ReplyKind:
        incarnation = self.acceptor.incarnation
        answer: Any = self.acceptor.answer_confirm(PEER, KEY, [where.pack()], incarnation, counter, taker, taker)
        return self._kind(answer, Event.ACCEPT)

    def _kind(self, answer: Any, event: Event) -> ReplyKind:
        reply = unpack_reply(answer[0], event)
        assert reply is not None
        return reply.kind

    def test_lost_memory_is_another_life(self) -> None:
        """A member with an empty or corrupted store has a new incarnation.

        It rejects requests to its old incarnation.
        """
        incarnation = self.acceptor.incarnation
        self.claim(place(1))
        note = CODEC.bucket_of(place(1))
        corrupt = MemoryStore()
        corrupt.set_note("decree/incarnation", incarnation)
        corrupt.set_note(note, b"rotten")
        for seed, store in enumerate((MemoryStore(), corrupt), start=5):
            self.store = store
            self.acceptor = self.made(seed)
            self.assertNotEqual(self.acceptor.incarnation, incarnation)
            self.assertRaises(
                Refused, self.acceptor.answer_claim, PEER, KEY, [place(1).pack()], incarnation, 9, b"b", 1.0
            )
            self.assertIsNone(self.acceptor.find_vote(place(1)))
            self.assertEqual(self.claim(place(1)), ReplyKind.GRANTED)

    def test_wrong_questions(self) -> None:
        """An invalid request is rejected and has no effect."""
        incarnation, where = self.acceptor.incarnation, place(1).pack()
        wrong: list[tuple[Any, ...]] = [
            (KEY[1:], [where], incarnation, 1, b"a", 1.0), (KEY, [], incarnation, 1, b"a", 1.0),
            (KEY, [where, where], incarnation, 1, b"a", 1.0),
            (KEY, [[1]], incarnation, 1, b"a", 1.0), (KEY, [where], b"", 1, b"a", 1.0),
            (KEY, [where], incarnation, 0, b"a", 1.0),
            (KEY, [where], incarnation, 1, b"", 1.0), (KEY, [where], incarnation, 1, b"a", 0.0),
            (KEY, [where], incarnation, 1, b"a", 601.0),
            (KEY, [place(n).pack() for n in range(MAX_TUPLES + 1)], incarnation, 1, b"a", 1.0),
        ]  # fmt: skip
        for question in wrong:
            self.assertRaises(Refused, self.acceptor.answer_claim, PEER, *question)
        self.assertRaises(Refused, self.acceptor.answer_confirm, PEER, KEY, [where], incarnation, 1, b"a", b"")
        self.assertEqual(len(self.acceptor), 0)

    def test_nothing_is_promised_about_what_is_over(self) -> None:
        """A tuple cannot be claimed after its publisher removed it, or replaced it by another tuple in its slot."""
        self.store.put(tuple_record(place(1)), 99.0)
        self.assertEqual(self.claim(place(1)), ReplyKind.GRANTED)
        self.store.put(tuple_record(place(2)), 99.0)
        self.store.put(record(place(2).name, None, 2), 99.0)
        self.assertEqual(self.claim(place(2)), ReplyKind.OUTBID)
        old = place(3)
        self.store.put(tuple_record(TupleId(KEY, ME.public, old.name, b"another!")), 99.0)
        self.assertEqual(self.claim(old), ReplyKind.OUTBID)

    def test_bounded(self) -> None:
        """A full member removes only registers of removed tuples, and keeps a lower bound for their ballots."""
        self.patch(module, "MAX_REGISTERS", 4)
        for number in range(4):
            self.claim(place(number), counter=number + 1, lease=100.0)
            self.confirm(place(number), counter=number + 1)
        self.assertRaises(Refused, self.claim, place(9))
        self.store.put(record(place(1).name, None), 99.0)
        self.assertEqual(self.claim(place(9), counter=1), ReplyKind.GRANTED)
        self.assertIsNone(self.acceptor.find_vote(place(1)))
        self.assertEqual(self.claim(place(1), counter=9), ReplyKind.OUTBID)
        self.store.put(record(place(0).name, None), 99.0)
        self.claim(place(10), counter=9)
        self.acceptor = self.made(2)
        self.assertEqual(self.claim(place(11), counter=1), ReplyKind.OUTBID)
        self.assertEqual(len(self.acceptor), 4)

    def test_unsettled(self) -> None:
        """An accepted take without an outcome is listed after a while, until it is completed or its tuple removed."""
        for number in (1, 2, 3):
            self.store.put(tuple_record(place(number)), 999.0)
            self.claim(place(number))
            self.confirm(place(number))
        self.assertEqual(self.acceptor.list_unfinished(), [])
        self.store.put(record(place(2).name, None, 2), 999.0)
        self.clock.advance(4.0)
        self.assertEqual([stored.tuple_id for stored in self.acceptor.list_unfinished()], [place(1), place(3)])
        self.assertEqual(self.acceptor.list_unfinished(), [])
        self.acceptor.finish(place(3))
        self.clock.advance(4.0)
        self.assertEqual([stored.tuple_id for stored in self.acceptor.list_unfinished()], [place(1)])
        self.acceptor = self.made(2)
        self.acceptor.load()
        self.clock.advance(4.0)
        self.assertIn(place(1), [stored.tuple_id for stored in self.acceptor.list_unfinished()])

    def test_answers_wait_for_the_disk(self) -> None:
        """A vote is sent only after the store has written it."""
        disk: Deferred[None] = Deferred()
        self.acceptor.wait_for_write = lambda: disk
        incarnation = self.acceptor.incarnation
        answer: Any = self.acceptor.answer_claim(PEER, KEY, [place(1).pack()], incarnation, 1, b"a", 1.0)
        self.assertNoResult(answer)
        disk.callback(None)
        self.assertEqual(self._kind(self.successResultOf(answer), Event.PREPARE), ReplyKind.GRANTED)

    def test_what_was_accepted_is_told(self) -> None:
        """A claim gets the value of an earlier, accepted take after a delay of one second.

        In this time the first taker can still complete its take.
        """
        self.claim(place(1), 1, b"a", lease=100.0)
        self.assertEqual([self.confirm(place(1)) for _ in range(2)], [ReplyKind.GRANTED] * 2)
        self.assertEqual(self.claim(place(1), 2, b"b"), ReplyKind.HELD)
        self.clock.advance(1.0)
        self.assertEqual(self.claim(place(1), 2, b"b"), ReplyKind.GRANTED)
        told = self.acceptor.answer_claim(PEER, KEY, [place(1).pack()], self.acceptor.incarnation, 3, b"b", 1.0)
        reply = unpack_reply(told[0], Event.PREPARE)  # type: ignore[index]
        assert reply is not None
        self.assertEqual((reply.accepted, reply.value), (Ballot(1, b"a"), b"a"))

    @settings(max_examples=300)
    @given(foreign=FOREIGN, noise=st.binary(max_size=60))
    def test_notes_are_decoded_totally(self, foreign: Any, noise: bytes) -> None:
        """A corrupted stored vote is decoded as None, without an exception."""
        good = [KEY, place(1).pack(), 1, b"a", 1.0, None]
        self.assertEqual(CODEC.unpack(CODEC.pack({})), ({}, True))
        rows = [[foreign], [[*good[:5], foreign]], [[*good[:5], [1, b"a", foreign]]], foreign]
        rows += [[[*good[:n], foreign, *good[n + 1 :]]] for n in range(5)]
        for fields in rows:
            try:
                packed = msgpack.packb(fields)
            except (ValueError, OverflowError):
                continue
            found, is_whole = CODEC.unpack(packed)
            self.assertTrue(found or not is_whole or fields == [])
        CODEC.unpack(noise)


class TupleRecordTests(SynchronousTestCase):
    def test_round_trip(self) -> None:
        """A tuple, and the record that it was taken, survive encoding and decoding."""
        council = (Member(PEER, b"i" * 8),)
        value = pack_tuple(place(1).mark, ("x", 1, None), council)
        self.assertEqual(parse_record(record(place(1).name, value)), StoredTuple(place(1), ("x", 1, None), council))
        self.assertEqual(parse_record(record("n", pack_taken(place(1), b"taker"))), TakenNote(place(1), b"taker"))

    def test_standing(self) -> None:
        """A taken tuple is no longer available; a different tuple in the same slot is available."""
        note = record("n", pack_taken(place(1), b"taker"))
        stored, taken = parse_records([tuple_record(place(1)), tuple_record(place(2)), note])
        self.assertEqual([one.tuple_id for one in stored], [place(2)])
        self.assertEqual(list(taken), [place(1)])
        newer = TupleId(KEY, ME.public, place(1).name, b"another!")
        reader = RecordParser()
        for _ in range(2):
            stored, _ = reader.parse([tuple_record(newer, 2), note])
            self.assertEqual([one.tuple_id for one in stored], [newer])

    def test_unlawful(self) -> None:
        """A record that is not a tuple record is decoded as None."""
        member = [*PEER.pack(), b"i" * 8]
        for fields in (
            [1, b"short", ["x"], [member]], [1, b"m" * 8, [], [member]], [1, b"m" * 8, ["x"], []],
            [1, b"m" * 8, ["x"], [member] * 2], [1, b"m" * 8, ["x"], [member[:3]]],
            [1, b"m" * 8, ["x"], [[1, 2, 3, 4]]],
            [2, [ME.public, "n", b"m"], b"t"], [2, place(1).pack(), b""], [3], 5,
        ):  # fmt: skip
            self.assertIsNone(parse_record(record("t", msgpack.packb(fields))), fields)
        self.assertIsNone(parse_record(record("t", None)))
        self.assertIsNone(parse_tuple_id(KEY, [ME.public, "", b"m" * 8]))

    @settings(max_examples=300)
    @given(foreign=FOREIGN, noise=st.binary(max_size=60))
    def test_total(self, foreign: Any, noise: bytes) -> None:
        """Any record is decoded as a stored tuple or as None, without an exception."""
        self.assertIsInstance(parse_record(record("t", noise)), StoredTuple | TakenNote | None)
        for fields in (foreign, [1, b"m" * 8, foreign, [foreign]], [1, b"m" * 8, ["x"], foreign], [2, foreign, b"t"]):
            try:
                packed = msgpack.packb(fields)
            except (ValueError, OverflowError):
                continue
            self.assertIsInstance(parse_record(record("t", packed)), StoredTuple | TakenNote | None)


OWN = b"own"


class ResolveTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock, self.rng = HeapClock(), random.Random(1)
        self.contacts = [Contact(Identity(bytes([n]) * 32).public, Address("10.0.0.1", 7000 + n)) for n in range(3)]
        self.acceptors = [TakeAcceptor(Exposed(), MemoryStore(), self.clock, self.rng) for _ in range(3)]
        pairs = zip(self.contacts, self.acceptors, strict=True)
        self.stored = StoredTuple(
            place(1), ("x",), tuple(Member(contact, acceptor.incarnation) for contact, acceptor in pairs)
        )
        self.silent: set[int] = set()
        self.council = TakeProposer(self.ask, self.clock, self.rng, Background(self.clock))

    def ask(self, contact: Contact, method: str, arguments: tuple[object, ...]) -> Deferred[Any]:
        number = self.contacts.index(contact)
        if number in self.silent:
            return fail(NoAnswer("it is silent"))
        return maybeDeferred(getattr(self.acceptors[number], method.replace("decree.", "answer_")), PEER, *arguments)

    def begin(self, number: int, counter: int, taker: bytes) -> None:
        """Let one member accept a take, which its taker does not complete."""
        acceptor = self.acceptors[number]
        places: list[object] = [place(1).pack()]
        acceptor.answer_claim(PEER, KEY, places, acceptor.incarnation, counter, taker, 1.0)
        acceptor.answer_confirm(PEER, KEY, places, acceptor.incarnation, counter, taker, taker)

    def resolve(self, value: bytes | None) -> bytes | None:
        found: list[bytes | None] = []
        Deferred.fromCoroutine(self.council.resolve(self.stored, OWN, value)).addCallback(found.append)
        self.clock.advance(30.0)
        return found[0]

    def test_own_value_gives_way(self) -> None:
        """A take that only one member accepted may have been decided.

        A later caller completes this take and drops its own value.
        """
        self.begin(0, 1, b"a")
        self.silent.add(2)
        self.assertEqual(self.resolve(OWN), b"a")

    def test_highest_ballot(self) -> None:
        """Of two unfinished takes the take with the higher ballot is completed."""
        self.begin(0, 2, b"b")
        self.begin(1, 1, b"a")
        self.silent.add(2)
        self.assertEqual(self.resolve(None), b"b")

    def test_nothing_was_begun(self) -> None:
        """Without an accepted value the caller's value is decided.

        If there is no value at all, nothing is decided or held.
        """
        self.assertIsNone(self.resolve(None))
        self.assertEqual(self.resolve(OWN), OWN)
        self.assertEqual(self.resolve(b"late"), OWN)
