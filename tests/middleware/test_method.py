"""Tests of the request history, which stores the replies to requests that may run only once."""

from __future__ import annotations

import random
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.contact import Contact
from middleware.entangled.errors import NoAnswer, Refused
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.wire import method
from middleware.entangled.wire.message import Request, encode
from middleware.entangled.wire.method import KEEP_ANSWER_S, MAX_INCARNATIONS, BadArguments, Method, RequestHistory
from tests.middleware.test_endpoint import DELAY, EndpointCase

ANN, BOB = b"a" * 32, b"b" * 32
PEER = Contact(ANN, Address("10.0.0.1", 1))
LIFE = 2**32


class KindTests(SynchronousTestCase):
    """Tests of the argument types that a ``Method`` accepts."""

    def test_annotations(self) -> None:
        """Builtin types are checked, whether written as types, names or unions.

        Any other annotation accepts all values.
        """
        rows: list[tuple[object, tuple[object, ...], tuple[object, ...]]] = [
            ("dict[str, list[int | None]] | None", ({}, None), (1, [])),
            ("list[object]|float", ([], 1, 1.5), ("x", {})),
            (bytes | None, (b"x", None), ("x", 1)),
            ("int", (1,), (True, 1.0)),
            ("Any", (1, "x"), ()),
            ("Nobody", (1, "x"), ()),
        ]
        for annotation, lawful, wrong in rows:

            def answer(peer: object, one: Any) -> None: ...

            answer.__annotations__["one"] = annotation
            method = Method("answer", answer)
            for value in lawful:
                method.run(PEER, (value,))
            for value in wrong:
                self.assertRaises(BadArguments, method.run, PEER, (value,))


class RequestHistoryTests(SynchronousTestCase):
    """Tests of ``RequestHistory``."""

    def setUp(self) -> None:
        """Create an empty request history."""
        self.history = RequestHistory()

    def run_one(self, public: bytes, number: int, oldest: int, now: float) -> None:
        """Begin a request and end it immediately."""
        self.history.forget_before(public, oldest, now)
        self.assertIsNotNone(self.history.begin(public, number, None, now, False))
        self.history.finish(public, number, b"done", now)

    def test_what_the_asker_has_is_forgotten(self) -> None:
        """Finished requests that are older than the caller's oldest open request are removed; later requests stay."""
        for number in range(10):
            self.run_one(ANN, number, 0, 1.0)
        self.run_one(BOB, 3, 3, 1.0)
        self.run_one(ANN, 10, 7, 1.0)
        self.assertEqual([n for n in range(12) if self.history.get(ANN, n)], [7, 8, 9, 10])
        self.assertEqual([n for n in range(12) if self.history.is_settled(ANN, n)], [0, 1, 2, 3, 4, 5, 6])
        self.assertIsNotNone(self.history.get(BOB, 3))
        self.assertEqual(len(self.history), 5)

    def test_word_that_was_overtaken(self) -> None:
        """If a late message names an older request as the oldest open one, settled requests stay settled."""
        self.history.forget_before(ANN, 7, 1.0)
        self.history.forget_before(ANN, 4, 1.0)
        self.assertTrue(self.history.is_settled(ANN, 5))

    def test_runs_on_though_given_up(self) -> None:
        """A running request that its caller has given up is removed when it ends."""
        self.history.begin(ANN, 1, None, 1.0, False)
        self.history.forget_before(ANN, 5, 1.0)
        self.assertIsNotNone(self.history.get(ANN, 1))
        self.history.finish(ANN, 1, b"late", 2.0)
        self.assertEqual((self.history.get(ANN, 1), len(self.history)), (None, 0))

    def test_another_life(self) -> None:
        """A restarted caller may use lower request numbers.

        The settled requests from before the restart stay settled.
        """
        self.run_one(ANN, 9 * LIFE + 5, 9 * LIFE + 5, 1.0)
        self.run_one(ANN, 2 * LIFE + 1, 2 * LIFE, 2.0)
        self.assertFalse(self.history.is_settled(ANN, 2 * LIFE + 1))
        self.assertTrue(self.history.is_settled(ANN, 9 * LIFE + 4))
        self.assertIsNotNone(self.history.get(ANN, 9 * LIFE + 5))

    def test_lives_are_bounded(self) -> None:
        """The request history stores a limited number of restarts per caller."""
        for life in range(100):
            self.history.forget_before(ANN, life * LIFE + 7, 1.0)
        known = [life for life in range(100) if self.history.is_settled(ANN, life * LIFE)]
        self.assertEqual(known, list(range(100 - MAX_INCARNATIONS, 100)))

    def test_nothing_is_kept_for_ever(self) -> None:
        """Each request removes some entries of silent peers, except those with running requests."""
        rng = random.Random(3)
        for _ in range(50):
            self.run_one(rng.randbytes(32), 1, 1, 1.0)
        self.history.begin(BOB, 1, None, 1.0, False)
        for number in range(120):
            self.run_one(ANN, number, number, 2.0 + KEEP_ANSWER_S)
        self.assertEqual((len(self.history), len(self.history._peers)), (2, 2))
        self.assertIsNotNone(self.history.get(BOB, 1))


class OnceTests(EndpointCase):
    """Tests of requests that run once, of requests that may run repeatedly, and of the limit on their number."""

    def equip(self, endpoint: Any) -> None:
        """Register a method that changes state and may run twice."""
        super().equip(endpoint)
        endpoint.expose("note", self.add, changes=True, idempotent=True)

    def flood(self, name: str, count: int) -> int:
        """Send ``count`` requests, eight at a time; return the number of replies and check that these requests ran."""
        answered: list[int] = []
        for number in range(count):
            asked = self.a.ask(self.to_b, name, number, changes=True)
            asked.addCallbacks(answered.append, lambda failure: failure.trap(Refused, NoAnswer))
            if number % 8 == 7:
                self.clock.advance(3 * DELAY)
        self.clock.advance(5)
        self.assertLessEqual(set(answered), set(self.runs))
        return len(answered)

    def test_honest_traffic_is_never_busy(self) -> None:
        """Thousands of changes within seconds are all answered, and the request history stays small."""
        self.patch(method, "MAX_PER_PEER", 100)
        self.switchboard.conditions = LinkConditions(DELAY / 4)
        self.assertEqual(self.flood("add", 3000), 3000)
        self.assertEqual(self.b.counters["busy"], 0)
        self.assertLess(len(self.b._dispatcher._history), 20)
        self.assertEqual(sorted(self.runs), list(range(3000)))

    def test_what_may_run_again_is_not_kept(self) -> None:
        """An idempotent change needs no entry in the request history, and may run again after a retransmission."""
        self.switchboard.conditions = LinkConditions(DELAY / 4, loss=0.3)
        answered = self.flood("note", 500)
        self.assertGreater(answered, 450)
        self.assertEqual(len(self.b._dispatcher._history), 0)
        self.assertGreater(len(self.runs), len(set(self.runs)))
        self.assertFalse(any(self.a._requester._requests))

    def test_a_question_that_was_given_up_does_not_run(self) -> None:
        """A retransmitted change that arrives after its caller got the reply is dropped."""
        self.assertEqual([self.got(self.a.ask(self.to_b, "add", n, changes=True)) for n in (1, 2)], [1, 2])
        session = self.a._peers.get(self.to_b.public).session  # type: ignore[union-attr]
        assert session is not None
        first = self.a._requester._next_number - 2
        self.a._send(session, encode(Request(first, "add", (1,))))
        self.clock.advance(1)
        self.assertEqual((self.runs, self.b.counters["late"]), ([1, 2], 1))

    def test_in_rough_weather_still_once(self) -> None:
        """Under loss, duplication and reordering no change runs twice."""
        self.switchboard.conditions = LinkConditions(DELAY, DELAY, loss=0.2, duplicate=0.3, reorder=0.4)
        self.assertGreater(self.flood("add", 800), 700)
        self.assertEqual(len(self.runs), len(set(self.runs)))
