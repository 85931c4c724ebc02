"""Tests of ``middleware.entangled.space.council``: what a claimant completes that others left half-way."""

from __future__ import annotations

import random
from typing import Any

from twisted.internet.defer import Deferred, fail, maybeDeferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.background import Background
from middleware.entangled.clock import HeapClock
from middleware.entangled.contact import Contact
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.errors import NoAnswer
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.space.council import Council
from middleware.entangled.space.posting import Member, Posted
from middleware.entangled.space.seat import Seat
from tests.middleware.space.test_seat import KEY, PEER, Exposed, place

OWN = b"own"


class ResolveTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock, self.rng = HeapClock(), random.Random(1)
        self.contacts = [Contact(Identity(bytes([n]) * 32).public, Address("10.0.0.1", 7000 + n)) for n in range(3)]
        self.seats = [Seat(Exposed(), MemoryStore(), self.clock, self.rng) for _ in range(3)]
        pairs = zip(self.contacts, self.seats, strict=True)
        self.posted = Posted(place(1), ("x",), tuple(Member(contact, seat.incarnation) for contact, seat in pairs))
        self.silent: set[int] = set()
        self.council = Council(self.ask, self.clock, self.rng, Background(self.clock))

    def ask(self, contact: Contact, method: str, arguments: tuple[object, ...]) -> Deferred[Any]:
        number = self.contacts.index(contact)
        if number in self.silent:
            return fail(NoAnswer("it is silent"))
        return maybeDeferred(getattr(self.seats[number], method.replace("decree.", "answer_")), PEER, *arguments)

    def begin(self, number: int, counter: int, taker: bytes) -> None:
        """Let one member accept a take, as if its taker had died then."""
        seat = self.seats[number]
        places: list[object] = [place(1).packed()]
        seat.answer_claim(PEER, KEY, places, seat.incarnation, counter, taker, 1.0)
        seat.answer_confirm(PEER, KEY, places, seat.incarnation, counter, taker, taker)

    def resolve(self, value: bytes | None) -> bytes | None:
        found: list[bytes | None] = []
        Deferred.fromCoroutine(self.council.resolve(self.posted, OWN, value)).addCallback(found.append)
        self.clock.advance(30.0)
        return found[0]

    def test_own_value_gives_way(self) -> None:
        """A take that one member has accepted may be decided, so it is completed, whoever asks."""
        self.begin(0, 1, b"a")
        self.silent.add(2)
        self.assertEqual(self.resolve(OWN), b"a")

    def test_highest_ballot(self) -> None:
        """Of two takes that were begun only the one under the higher ballot may be decided."""
        self.begin(0, 2, b"b")
        self.begin(1, 1, b"a")
        self.silent.add(2)
        self.assertEqual(self.resolve(None), b"b")

    def test_nothing_was_begun(self) -> None:
        """Where nothing was accepted the own value is decided, and without one nothing is, nor held."""
        self.assertIsNone(self.resolve(None))
        self.assertEqual(self.resolve(OWN), OWN)
        self.assertEqual(self.resolve(b"late"), OWN)
