"""Tests of ``middleware.entangled.quorum.proposer``: how a round ends, and what is decided under any schedule."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.quorum.ballot import Ballot
from middleware.entangled.quorum.proposer import Outcome, Result, conclude, decide
from middleware.entangled.quorum.register import Kind, Reply
from middleware.entangled.quorum.round import Tally
from tests.middleware.quorum.members import LEASE, TAKE, Member, Use

LOW, MID = Ballot(1, b"a"), Ballot(2, b"b")


class ConcludeTests(SynchronousTestCase):
    """How a round ends."""

    def _came(self, *replies: Reply | None) -> Outcome | None:
        tally = Tally(3)
        for place, reply in enumerate(replies):
            tally.add(place, reply)
        return conclude(tally) if tally.is_decided else None

    def test_majority_wins(self) -> None:
        """Two promises of three win, without waiting for the third answer."""
        self.assertIsNone(self._came(Reply(Kind.GRANTED, Ballot(1, b""))))
        self.assertEqual(self._came(*[Reply(Kind.GRANTED, Ballot(1, b""))] * 2), Outcome(Result.WON, None, 1))

    def test_highest_accepted_value_must_be_completed(self) -> None:
        """Of what the promising members have accepted, the value of the highest ballot is the one to go on with."""
        old, new = (
            Reply(Kind.GRANTED, Ballot(9, b""), accepted=LOW, value=b"old"),
            Reply(Kind.GRANTED, Ballot(9, b""), accepted=MID, value=b"new"),
        )
        self.assertEqual(self._came(old, new), Outcome(Result.WON, b"new", 9))
        self.assertEqual(self._came(Reply(Kind.GRANTED, Ballot(9, b"")), old), Outcome(Result.WON, b"old", 9))

    def test_what_a_majority_accepted_is_decided(self) -> None:
        """Two members that accepted one ballot settle it, whatever they answered."""
        told = Reply(Kind.OUTBID, Ballot(9, b""), accepted=LOW, value=b"x")
        self.assertEqual(self._came(told, told), Outcome(Result.DECIDED, b"x", 9))
        self.assertEqual(
            self._came(*[Reply(Kind.GRANTED, Ballot(1, b""), accepted=LOW, value=b"x")] * 2),
            Outcome(Result.DECIDED, b"x", 1),
        )

    def test_the_same_value_under_two_ballots_is_not_yet_decided(self) -> None:
        """Two acceptances under different ballots are no majority for either."""
        a, b = (
            Reply(Kind.OUTBID, Ballot(9, b""), accepted=LOW, value=b"x"),
            Reply(Kind.OUTBID, Ballot(9, b""), accepted=MID, value=b"x"),
        )
        outcome = self._came(a, b)
        self.assertEqual(outcome and outcome.result, Result.OUTBID)

    def test_lost_rounds(self) -> None:
        """A round is lost when a majority cannot be had any more: leased, outbid or silent."""
        leased = Reply(Kind.HELD, Ballot(4, b""), remaining=2.5)
        self.assertIsNone(self._came(leased))
        self.assertEqual(self._came(leased, None), Outcome(Result.HELD, None, 4, 2.5))
        self.assertEqual(self._came(leased, Reply(Kind.OUTBID, Ballot(7, b""))), Outcome(Result.OUTBID, None, 7, 2.5))
        self.assertEqual(self._came(None, None), Outcome(Result.SILENT))
        self.assertEqual(self._came(None, Reply(Kind.UNPREPARED), None), Outcome(Result.SILENT))


class DecideTests(SynchronousTestCase):
    """Behaviour of ``decide``, with the acceptors of both users."""

    def decide(self, seed: int, use: Use) -> set[Any]:
        """What three proposers are told of one register, while losses and restarts come between their questions."""
        rng, now = random.Random(seed), 0.0
        members = [Member(use) for _ in range(3)]
        waiting: list[Deferred[None]] = []
        told: set[Any] = set()

        async def turn(seconds: float = 0.0) -> None:
            waiting.append(Deferred())
            await waiting[-1]

        async def ask(question: Callable[[Member], Reply]) -> Outcome:
            tally = Tally(3, (Kind.GRANTED, Kind.SEALED))
            for place, member in enumerate(members):
                await turn()
                tally.add(place, question(member) if rng.random() < 0.7 else None)
            return conclude(tally)

        async def prepare(ballot: Ballot) -> Outcome:
            reserve = rng.choice([0.0, 1.0]) if use is TAKE else 0.0
            return await ask(lambda member: member.prepare(ballot, now, reserve))

        async def accept(ballot: Ballot, value: Any) -> Outcome:
            return await ask(lambda member: member.accept(ballot, value, now))

        for name, value in zip(use.names, use.values, strict=True):
            deciding = decide(Ballot(1, name), value, prepare, accept, turn, rng)
            Deferred.fromCoroutine(deciding).addCallback(lambda decided: told.add(decided[1]))
        for _ in range(20_000):
            if not waiting:
                break
            now += rng.choice([0.0, 0.0, 0.3])
            if rng.random() < 0.02:
                rng.choice(members).restart(now)
            waiting.pop(rng.randrange(len(waiting))).callback(None)
        self.assertEqual(waiting, [], seed)
        return told

    def test_one_value(self) -> None:
        """Whatever is lost, late or restarted, all proposers are told the same value."""
        for use in (TAKE, LEASE):
            for seed in range(100):
                self.assertEqual(len(self.decide(seed, use)), 1, (use.key, seed))

    def test_nothing_to_propose(self) -> None:
        """A proposer without a value proposes nothing, and completes what another began."""
        for use in (TAKE, LEASE):
            member = Member(use)

            async def prepare(ballot: Ballot) -> Outcome:
                return self._concluded(member.prepare(ballot, 9.0))  # noqa: B023

            async def accept(ballot: Ballot, value: Any) -> Outcome:
                return self._concluded(member.accept(ballot, value, 9.0))  # noqa: B023

            async def sleep(seconds: float) -> None:
                self.fail("nothing was in the way")

            first, second, third = (Ballot(number, name) for number, name in zip((6, 7, 8), use.names, strict=True))
            rng, phases = random.Random(1), (prepare, accept, sleep)
            told = Deferred.fromCoroutine(decide(first, None, *phases, rng))
            self.assertEqual(self.successResultOf(told), (first, None))
            member.prepare(second, 0.0)
            member.accept(second, use.values[1], 0.0)
            told = Deferred.fromCoroutine(decide(third, None, *phases, rng))
            self.assertEqual(self.successResultOf(told), (third, use.values[1]))

    def _concluded(self, reply: Reply) -> Outcome:
        tally = Tally(1, (Kind.GRANTED, Kind.SEALED))
        tally.add(0, reply)
        return conclude(tally)
