"""Tests of ``middleware.entangled.quorum.proposer``: the outcome of a round, and decisions under any schedule."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.quorum.ballot import NO_BALLOT, Ballot
from middleware.entangled.quorum.proposer import Outcome, Result, conclude, decide
from middleware.entangled.quorum.register import Reply, ReplyKind
from middleware.entangled.quorum.round import Tally
from tests.middleware.quorum.members import LEASE, TAKE, Member, Use

LOW, MID = Ballot(1, b"a"), Ballot(2, b"b")


def reply(kind: ReplyKind, counter: int = 9, accepted: Ballot = NO_BALLOT, value: bytes | None = None) -> Reply:
    return Reply(kind, Ballot(counter, b""), accepted=accepted, value=value)


class ConcludeTests(SynchronousTestCase):
    def test_conclude(self) -> None:
        """The replies determine the outcome of a round, which is won, decided, held, outbid or silent.

        A value that was accepted under the highest ballot is completed.
        """
        yes, held = reply(ReplyKind.GRANTED), Reply(ReplyKind.HELD, Ballot(4, b""), remaining=2.5)
        old, new = reply(ReplyKind.GRANTED, 9, LOW, b"old"), reply(ReplyKind.GRANTED, 9, MID, b"new")
        outbid = reply(ReplyKind.OUTBID, 9, LOW, b"x")
        rows: list[tuple[list[Reply | None], Outcome | None]] = [
            ([yes], None),
            ([yes, yes], Outcome(Result.WON, None, 9)),
            ([old, new], Outcome(Result.WON, b"new", 9)),
            ([yes, old], Outcome(Result.WON, b"old", 9)),
            ([outbid, outbid], Outcome(Result.DECIDED, b"x", 9)),
            ([old, old], Outcome(Result.DECIDED, b"old", 9)),
            # Two acceptors accepted the same value under two different ballots, which is not a decision.
            ([outbid, reply(ReplyKind.OUTBID, 9, MID, b"x")], Outcome(Result.OUTBID, None, 9)),
            ([held], None),
            ([held, None], Outcome(Result.HELD, None, 4, 2.5)),
            ([held, reply(ReplyKind.OUTBID, 7)], Outcome(Result.OUTBID, None, 7, 2.5)),
            ([None, None], Outcome(Result.SILENT)),
            ([None, Reply(ReplyKind.UNPREPARED), None], Outcome(Result.SILENT)),
        ]
        for replies, outcome in rows:
            tally = Tally(3)
            for place, each in enumerate(replies):
                tally.add(place, each)
            self.assertEqual(conclude(tally) if tally.is_decided else None, outcome, replies)


class DecideTests(SynchronousTestCase):
    def decide(self, seed: int, use: Use) -> set[Any]:
        """Return the values that three proposers learn for one register, with lost requests and restarts."""
        rng, now = random.Random(seed), 0.0
        members = [Member(use) for _ in range(3)]
        waiting: list[Deferred[None]] = []
        told: set[Any] = set()

        async def turn(seconds: float = 0.0) -> None:
            waiting.append(Deferred())
            await waiting[-1]

        async def ask(question: Callable[[Member], Reply]) -> Outcome:
            tally = Tally(3, (ReplyKind.GRANTED, ReplyKind.SEALED))
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
        """All proposers learn the same value under loss, reordering and restarts."""
        for use in (TAKE, LEASE):
            for seed in range(100):
                self.assertEqual(len(self.decide(seed, use)), 1, (use.key, seed))

    def test_nothing_to_propose(self) -> None:
        """A proposer without a value proposes nothing, but completes an accepted value of another proposer."""
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
        tally = Tally(1, (ReplyKind.GRANTED, ReplyKind.SEALED))
        tally.add(0, reply)
        return conclude(tally)
