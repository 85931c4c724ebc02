"""Tests of the right to act: the council member's rules as a table, the claimants in all weathers."""

from __future__ import annotations

import random
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.internet.defer import Deferred, fail, succeed
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.lease import CLOCK_MARGIN, Acceptor, Grant, Lessee, grant_of
from middleware.entangled.clock import HeapClock
from middleware.entangled.errors import NoAnswer

TTL = 1.5


class AcceptorTests(SynchronousTestCase):
    def test_rules(self) -> None:
        """Each claim, made 1 s after a grant of token 5 to a, that runs out at 2 s or was released, is answered so."""
        rows = [
            # holder, token, now, released, granted
            ("a", 5, 1.0, False, True),  # a renewal
            ("a", 6, 1.0, False, True),
            ("a", 4, 1.0, False, False),  # an older token
            ("b", 4, 1.0, False, False),
            ("b", 5, 1.0, False, False),
            ("b", 6, 1.0, False, False),  # a's lease is not over
            ("b", 6, 1.999, False, False),
            ("b", 6, 2.0, False, True),  # now it is
            ("b", 5, 2.0, False, False),  # but never by a token that was used
            ("b", 4, 9.0, False, False),
            ("a", 5, 2.5, False, True),  # nobody else came between
            ("b", 6, 1.0, True, True),  # released early
            ("b", 5, 1.0, True, False),
            ("a", 5, 1.0, True, False),  # a claim that the release has overtaken
            ("a", 6, 1.0, True, True),
        ]
        for holder, token, now, released, granted in rows:
            acceptor = Acceptor()
            self.assertEqual(acceptor.claim("t", "a", 5, 2.0, 0.0), Grant(True, 5, 2.0))
            if released:
                acceptor.release("t", "a", 5, 1.0)
            answer = acceptor.claim("t", holder, token, 3.0, now)
            self.assertEqual(answer.granted, granted, (holder, token, now, released))
            left = 0.0 if released else max(0.0, 2.0 - now)
            self.assertEqual(answer, Grant(True, token, 3.0) if granted else Grant(False, 5, left))

    def test_only_the_holder_releases(self) -> None:
        """A release by another, or of another token or task, changes nothing."""
        acceptor = Acceptor()
        acceptor.claim("t", "a", 5, 2.0, 0.0)
        for task, holder, token in (("t", "b", 5), ("t", "a", 4), ("u", "a", 5)):
            acceptor.release(task, holder, token, 0.5)
        self.assertFalse(acceptor.claim("t", "b", 9, 2.0, 1.0).granted)

    def test_tasks_are_apart(self) -> None:
        """A lease on one task stands in the way of no other."""
        acceptor = Acceptor()
        acceptor.claim("t", "a", 5, 2.0, 0.0)
        self.assertTrue(acceptor.claim("u", "b", 1, 2.0, 0.0).granted)

    def test_restarted_member_abstains(self) -> None:
        """One that has just begun may have forgotten a grant, so it waits until that must have run out."""
        acceptor = Acceptor(10.0)
        self.assertEqual(acceptor.claim("t", "a", 1, 2.0, 11.0), Grant(False, 0, 1.0))
        self.assertTrue(acceptor.claim("t", "a", 1, 2.0, 12.0).granted)

    def test_full_council_forgets_no_lease(self) -> None:
        """Where there is no room, what has run out gives way; while nothing has, new tasks are refused."""
        acceptor = Acceptor()
        acceptor.MAX_TASKS = 2
        acceptor.claim("t", "a", 1, 2.0, 0.0)
        acceptor.claim("u", "a", 1, 3.0, 0.0)
        self.assertEqual(acceptor.claim("v", "b", 1, 2.0, 1.0), Grant(False, 0, 1.0))
        self.assertFalse(acceptor.claim("t", "b", 2, 2.0, 1.0).granted)
        self.assertTrue(acceptor.claim("v", "b", 1, 2.0, 2.0).granted)
        self.assertFalse(acceptor.claim("u", "b", 2, 2.0, 2.0).granted)

    @settings(max_examples=100, deadline=None, derandomize=True, database=None)
    @given(st.lists(st.tuples(st.sampled_from("abr"), st.integers(1, 4), st.floats(0.0, 1.0)), max_size=20))
    def test_never_two_and_never_older(self, events: list[tuple[str, int, float]]) -> None:
        """Whatever is claimed and released, no grant overlaps one of another holder, and tokens never go down."""
        acceptor, now, highest = Acceptor(), 0.0, 0
        holder, until = "", 0.0
        for who, token, pause in events:
            now += pause
            if who == "r":
                acceptor.release("t", holder, token, now)
                if token == highest:
                    until = min(until, now)
            elif acceptor.claim("t", who, token, 1.0, now).granted:
                self.assertTrue(who == holder or now >= until)
                self.assertGreaterEqual(token, highest)
                holder, highest, until = who, token, now + 1.0


class Council:
    """Three members behind a wire with weather; claims and answers take their time or are lost."""

    def __init__(self, clock: HeapClock, rng: random.Random, loss: float, delay: float, size: int = 3) -> None:
        self.members = [Acceptor() for _ in range(size)]
        self.cut: set[tuple[str, int]] = set()
        self.released: list[tuple[int, str, int]] = []
        self._clock = clock
        self._rng = rng
        self._loss = loss
        self._delay = delay

    def asker(self, holder: str) -> Any:
        """What a lessee is given to ask with."""

        def ask(member: int, method: str, arguments: tuple[Any, ...]) -> Deferred[Any]:
            answer: Deferred[Any] = Deferred()
            timeout = self._clock.callLater(TTL / 3, lambda: answer.errback(NoAnswer("late")))

            def arrive() -> None:
                result = self.answer(member, method, holder, arguments)
                if not self._is_lost(holder, member):
                    self._clock.callLater(self._rng.random() * self._delay, come_back, result)

            def come_back(result: object) -> None:
                if not answer.called:
                    timeout.cancel()
                    answer.callback(result)

            if not self._is_lost(holder, member):
                self._clock.callLater(self._rng.random() * self._delay, arrive)
            return answer

        return ask

    def answer(self, member: int, method: str, holder: str, arguments: tuple[Any, ...]) -> object:
        """What the member does."""
        now = self._clock.seconds()
        if method == "lease.release":
            self.released.append((member, holder, arguments[1]))
            self.members[member].release(arguments[0], holder, arguments[1], now)
            return None
        grant = self.members[member].claim(arguments[0], holder, arguments[1], arguments[2], now)
        return [grant.granted, grant.token, grant.remaining]

    def _is_lost(self, holder: str, member: int) -> bool:
        return (holder, member) in self.cut or self._rng.random() < self._loss


class LesseeCase(SynchronousTestCase):
    """Claimants on one turned clock."""

    def setUp(self) -> None:
        self.clock = HeapClock()
        self.changes = 0

    def council(self, loss: float = 0.0, delay: float = 0.01, seed: int = 1) -> Council:
        """Three members."""
        self.rng = random.Random(seed)
        self.members = Council(self.clock, self.rng, loss, delay)
        return self.members

    def lessee(self, holder: str, floor: int = 0) -> Lessee:
        """A claimant."""
        ask = self.members.asker(holder)
        return Lessee("t", holder, TTL, len(self.members.members), ask, self.clock, self.rng, self.changed, floor)

    def changed(self) -> None:
        """Count a change."""
        self.changes += 1


class LesseeTests(LesseeCase):
    def test_win_keep_and_release(self) -> None:
        """A claimant alone wins, keeps the lease by renewing it with the same token, and leaves nothing behind."""
        self.council()
        a = self.lessee("a")
        a.want()
        a.want()
        self.clock.advance(0.1)
        assert a.lease is not None
        for _ in range(100):
            self.clock.advance(0.1)
            self.assertEqual(a.lease and a.lease.token, 1)
        a.release()
        self.assertIsNone(a.lease)
        self.clock.advance(2.0)
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def test_deadline_counts_from_the_sending(self) -> None:
        """However long the answers take, the lease ends a ttl after the claim was sent, less the margin."""
        slow: list[Deferred[Any]] = [Deferred(), Deferred(), Deferred()]
        a = Lessee("t", "a", TTL, 3, lambda n, *_: slow[n], self.clock, random.Random(1), self.changed)
        self.clock.advance(7.0)
        a.want()
        self.clock.advance(1.0)
        slow[0].callback([True, 1, TTL])
        self.assertIsNone(a.lease)
        slow[1].callback([True, 1, TTL])
        assert a.lease is not None
        self.assertAlmostEqual(a.lease.deadline, 7.0 + TTL * (1.0 - CLOCK_MARGIN))
        self.clock.run_until(a.lease.deadline)
        self.assertIsNone(a.lease)

    def test_takeover_after_the_end(self) -> None:
        """When the holder falls silent another one gets the lease soon after it ran out, with a higher token."""
        council = self.council()
        a, b = self.lessee("a"), self.lessee("b")
        a.want()
        self.clock.advance(0.5)
        b.want()
        self.clock.advance(0.5)
        self.assertIsNone(b.lease)
        council.cut = {("a", member) for member in range(3)}
        self.clock.advance(2 * TTL)
        self.assertIsNone(a.lease)
        assert b.lease is not None
        self.assertGreater(b.lease.token, 1)

    def test_floor(self) -> None:
        """A claimant whose body has obeyed a token never comes with that one or an older one."""
        self.council()
        a = self.lessee("a", floor=41)
        a.want()
        self.clock.advance(0.2)
        self.assertEqual(a.token, 42)

    def test_minority_grants_are_given_back(self) -> None:
        """What less than a majority granted is released at once, so that it keeps nobody waiting."""
        council = self.council()
        council.cut = {("a", 1), ("a", 2)}
        a, b = self.lessee("a"), self.lessee("b")
        a.want()
        self.clock.advance(TTL / 3 + 0.05)
        self.assertIn((0, "a", 1), council.released)
        a.release()
        self.clock.advance(0.5)
        b.want()
        council.cut.add(("b", 1))
        self.clock.advance(TTL - 0.7)
        self.assertIsNotNone(b.lease)

    def test_want_again_while_a_renewal_is_under_way(self) -> None:
        """A grant that was asked for before the release is not used after it: the members have let go of it."""
        slow: dict[tuple[int, int], Deferred[Any]] = {}
        calls: list[tuple[str, int]] = []

        def ask(member: int, method: str, arguments: tuple[Any, ...]) -> Deferred[Any]:
            calls.append((method, arguments[1]))
            if method == "lease.release":
                return succeed(None)
            if self.clock.seconds() == 0.0:
                return succeed([True, arguments[1], TTL])
            slow[member, arguments[1]] = Deferred()
            return slow[member, arguments[1]]

        a = Lessee("t", "a", TTL, 3, ask, self.clock, random.Random(1), self.changed)
        a.want()
        self.clock.advance(TTL / 3)
        self.assertEqual(sorted(slow), [(0, 1), (1, 1), (2, 1)])
        a.release()
        a.want()
        for member in range(3):
            slow[member, 1].callback([True, 1, TTL])
        self.assertIsNone(a.lease)
        for member in range(3):
            slow[member, 2].callback([True, 2, TTL])
        self.assertEqual(a.lease and a.lease.token, 2)
        self.assertEqual(calls.count(("lease.release", 2)), 0)

    def test_grant_after_the_end_is_given_back(self) -> None:
        """A grant that arrives when nobody wants it any more goes back to whoever gave it."""
        council = self.council(delay=0.2)
        a, b = self.lessee("a"), self.lessee("b")
        a.want()
        self.clock.advance(0.01)
        a.release()
        self.clock.advance(0.7)
        b.want()
        self.clock.advance(0.5)
        self.assertIsNotNone(b.lease)
        self.assertTrue(council.released)

    def test_strange_answers(self) -> None:
        """An answer that is no grant counts as a refusal, and a council of nobody grants nothing."""
        answers: list[Any] = [None, [True], [1, 1, 1.0]]
        a = Lessee("t", "a", TTL, 3, lambda n, *_: succeed(answers[n]), self.clock, random.Random(1), self.changed)
        a.want()
        self.assertIsNone(a.lease)
        a.release()
        nobody = Lessee("t", "a", TTL, 0, lambda *_: fail(NoAnswer("")), self.clock, random.Random(1), self.changed)
        nobody.want()
        self.assertIsNone(nobody.lease)
        nobody.release()
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def test_loss_is_told(self) -> None:
        """Whoever held the lease and cannot renew it is told when the next claim fails."""
        council = self.council()
        a = self.lessee("a")
        a.want()
        self.clock.advance(0.1)
        self.assertEqual(self.changes, 1)
        council.cut = {("a", member) for member in range(3)}
        self.clock.advance(2 * TTL)
        self.assertGreater(self.changes, 1)
        self.assertEqual(a.token, 0)


class SafetyTests(LesseeCase):
    def test_at_most_one_holder(self) -> None:
        """In every weather, with cuts, hesitation and slow answers, no two hold the lease at one instant."""
        wins = sum(self.storm(seed) for seed in range(60))
        self.assertGreater(wins, 100)

    def storm(self, seed: int) -> int:
        """One storm; how many times the lease was won anew."""
        self.clock = HeapClock()
        dice = random.Random(f"storm {seed}")
        council = self.council(loss=dice.choice([0.0, 0.2, 0.4]), delay=dice.choice([0.01, 0.3, 0.9]), seed=seed)
        lessees = [self.lessee(name) for name in "abc"]
        tokens = [0]
        for _ in range(400):
            self.clock.advance(0.03)
            if dice.random() < 0.05:
                council.cut = {(name, n) for name in "abc" for n in range(3) if dice.random() < 0.4}
            one = dice.choice(lessees)
            if dice.random() < 0.15:
                (one.release if dice.random() < 0.4 else one.want)()
                if dice.random() < 0.3:
                    one.want()
            held = [lessee.lease for lessee in lessees if lessee.lease is not None]
            self.assertLessEqual(len(held), 1, f"seed {seed}: two act at {self.clock.seconds():.2f}")
            if held and held[0].token != tokens[-1]:
                self.assertGreater(held[0].token, tokens[-1], f"seed {seed}: the token went down")
                tokens.append(held[0].token)
        for lessee in lessees:
            lessee.release()
        self.clock.advance(3.0)
        self.assertEqual(self.clock.getDelayedCalls(), [])
        return len(tokens) - 1


class GrantTests(SynchronousTestCase):
    def test_lawful(self) -> None:
        """A grant is read as it was given; what cannot be a duration counts as none."""
        self.assertEqual(grant_of([True, 3, 1.0]), Grant(True, 3, 1.0))
        self.assertEqual(grant_of([False, 0, -1.0]), Grant(False, 0, 0.0))
        self.assertEqual(grant_of([False, 0, float("nan")]), Grant(False, 0, 0.0))

    def test_unlawful(self) -> None:
        """Anything else is no grant."""
        answers: tuple[object, ...] = (
            None,
            5,
            [],
            [True, 1],
            [1, 1, 1.0],
            [True, True, 1.0],
            [True, -1, 1.0],
            [True, 2**62, 1.0],
            [True, 1, 1],
            [True, 1, "x"],
            {},
            [True, 1, 1.0, 0],
        )
        for answer in answers:
            self.assertIsNone(grant_of(answer), answer)
