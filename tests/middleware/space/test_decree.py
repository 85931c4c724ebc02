"""Tests of decrees: the table row by row, the tally, and what comes from the wire."""

from __future__ import annotations

import random
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.space.decree import (
    ACCEPTED_LEASE,
    TABLE,
    Ballot,
    Event,
    Kind,
    Outcome,
    Reply,
    Result,
    Stand,
    State,
    Tally,
    Vote,
    reply_unpacked,
)

LOW, MID, HIGH = Ballot(1, b"a"), Ballot(2, b"b"), Ballot(3, b"c")
REPLIES = st.builds(
    Reply,
    st.sampled_from(list(Kind)),
    st.integers(0, 2**48 - 1),
    st.floats(0.0, 600.0),
)
FOREIGN: Any = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3) | st.binary(max_size=45),
    lambda inner: st.lists(inner, max_size=5),
    max_leaves=10,
)


def vote(state: State) -> Vote:
    """A vote in ``state``; what it promised is ``MID``, and leased until moment 10."""
    made = Vote()
    if state is not State.FREE:
        made.claim(MID, 10.0, 0.0)
    if state is State.CONFIRMED:
        made.confirm(MID, b"b", 0.0)
        made.until = 10.0
    return made


BALLOTS = {Stand.LOWER: (LOW, 1.0), Stand.SAME: (MID, 1.0), Stand.EARLY: (HIGH, 1.0), Stand.HIGHER: (HIGH, 11.0)}


class VoteTests(SynchronousTestCase):
    """Behaviour of ``Vote``."""

    def test_every_row(self) -> None:
        """Each state, event and stand of a ballot gives the answer and the next state of its row."""
        for (state, event, stand), (kind, after) in TABLE.items():
            asked, (ballot, now) = vote(state), BALLOTS[stand]
            reply = {
                Event.CLAIM: lambda v=asked, b=ballot, n=now: v.claim(b, 5.0, n),
                Event.CONFIRM: lambda v=asked, b=ballot, n=now: v.confirm(b, b"x", n),
                Event.RELEASE: lambda v=asked, b=ballot, n=now: v.release(b, n),
            }[event]()
            self.assertEqual((reply.kind, asked.state), (kind, after), (state, event, stand))

    def test_no_row_is_missing(self) -> None:
        """Every state has a row for every event and stand that can occur in it."""
        stands = {State.FREE: [Stand.HIGHER], State.CLAIMED: list(Stand), State.CONFIRMED: list(Stand)}
        wanted = {(state, event, stand) for state in State for event in Event for stand in stands[state]}
        self.assertEqual(set(TABLE), wanted)

    def test_claim_leases(self) -> None:
        """A claim keeps others out for its lease, the same ballot again renews it, and then another may claim."""
        made = Vote()
        self.assertEqual(made.claim(LOW, 2.0, 0.0).remaining, 2.0)
        self.assertEqual(made.claim(MID, 2.0, 1.0).kind, Kind.LEASED)
        self.assertEqual(made.claim(LOW, 2.0, 1.5).remaining, 2.0)
        self.assertEqual(made.claim(MID, 2.0, 3.4).kind, Kind.LEASED)
        self.assertEqual(made.claim(MID, 2.0, 3.5).kind, Kind.PROMISED)

    def test_the_same_taker_may_outbid_itself(self) -> None:
        """A lease keeps out others, not the one who holds it."""
        made = Vote()
        made.claim(Ballot(1, b"a"), 10.0, 0.0)
        self.assertEqual(made.claim(Ballot(2, b"a"), 10.0, 1.0).kind, Kind.PROMISED)

    def test_release_ends_the_lease(self) -> None:
        """After a release another may claim at once."""
        made = Vote()
        made.claim(LOW, 10.0, 0.0)
        made.release(LOW, 1.0)
        self.assertEqual(made.claim(MID, 1.0, 1.0).kind, Kind.PROMISED)

    def test_promise_tells_what_was_accepted(self) -> None:
        """A later claimant is told what was accepted, and gets a chance to complete it soon."""
        made = Vote()
        made.claim(LOW, 100.0, 0.0)
        made.confirm(LOW, b"taker", 1.0)
        self.assertEqual(made.claim(HIGH, 1.0, 1.5).kind, Kind.LEASED)
        reply = made.claim(HIGH, 1.0, 1.0 + ACCEPTED_LEASE)
        self.assertEqual((reply.kind, reply.accepted, reply.value), (Kind.PROMISED, LOW, b"taker"))

    def test_repeated_confirm(self) -> None:
        """The same confirm again gets the same answer."""
        made = vote(State.CLAIMED)
        answers = [made.confirm(MID, b"b", 1.0) for _ in range(2)]
        self.assertEqual(answers[0], answers[1])
        self.assertEqual(answers[0].kind, Kind.ACCEPTED)


class TallyTests(SynchronousTestCase):
    """Behaviour of ``Tally``."""

    def _came(self, *replies: Reply | None, wanted: Kind = Kind.PROMISED) -> Outcome | None:
        tally = Tally(3, wanted)
        for reply in replies:
            tally.add(reply)
        return tally.outcome

    def test_majority_wins(self) -> None:
        """Two promises of three win, without waiting for the third answer."""
        self.assertIsNone(self._came(Reply(Kind.PROMISED, 1)))
        self.assertEqual(self._came(*[Reply(Kind.PROMISED, 1)] * 2), Outcome(Result.WON, None, 1))

    def test_highest_accepted_value_must_be_completed(self) -> None:
        """Of what the promising members have accepted, the value of the highest ballot is the one to go on with."""
        old, new = Reply(Kind.PROMISED, 9, 0.0, LOW, b"old"), Reply(Kind.PROMISED, 9, 0.0, MID, b"new")
        self.assertEqual(self._came(old, new), Outcome(Result.WON, b"new", 9))
        self.assertEqual(self._came(Reply(Kind.PROMISED, 9), old), Outcome(Result.WON, b"old", 9))

    def test_what_a_majority_accepted_is_decided(self) -> None:
        """Two members that accepted one ballot settle it, whatever they answered."""
        told = Reply(Kind.OUTBID, 9, 0.0, LOW, b"x")
        self.assertEqual(self._came(told, told), Outcome(Result.DECIDED, b"x", 9))
        self.assertEqual(
            self._came(*[Reply(Kind.ACCEPTED, 1, 0.0, LOW, b"x")] * 2, wanted=Kind.ACCEPTED),
            Outcome(Result.DECIDED, b"x", 1),
        )

    def test_the_same_value_under_two_ballots_is_not_yet_decided(self) -> None:
        """Two acceptances under different ballots are no majority for either."""
        a, b = Reply(Kind.OUTBID, 9, 0.0, LOW, b"x"), Reply(Kind.OUTBID, 9, 0.0, MID, b"x")
        outcome = self._came(a, b)
        self.assertEqual(outcome and outcome.result, Result.OUTBID)

    def test_lost_rounds(self) -> None:
        """A round is lost when a majority cannot be had any more: leased, outbid or silent."""
        leased = Reply(Kind.LEASED, 4, 2.5)
        self.assertIsNone(self._came(leased))
        self.assertEqual(self._came(leased, None), Outcome(Result.LEASED, None, 4, 2.5))
        self.assertEqual(self._came(leased, Reply(Kind.OUTBID, 7)), Outcome(Result.OUTBID, None, 7, 2.5))
        self.assertEqual(self._came(None, None), Outcome(Result.SILENT))
        self.assertEqual(self._came(None, Reply(Kind.UNCLAIMED), None, wanted=Kind.ACCEPTED), Outcome(Result.SILENT))

    def test_agreement_under_any_schedule(self) -> None:
        """However claims and confirms of five takers fall on three members, at most one value is ever decided."""
        for seed in range(300):
            rng = random.Random(seed)
            members = [Vote() for _ in range(3)]
            decided, counter, now = set(), 0, 0.0
            pending: list[tuple[Ballot, bytes]] = []
            for _ in range(40):
                now += rng.uniform(0.0, 3.0)
                heard = rng.sample(members, rng.randrange(4))
                if pending and rng.random() < 0.5:
                    ballot, value = pending.pop(rng.randrange(len(pending)))
                    tally = Tally(3, Kind.ACCEPTED)
                    for member in members:
                        tally.add(member.confirm(ballot, value, now) if member in heard else None)
                    outcome = tally.outcome
                    if outcome and outcome.result is Result.WON:
                        decided.add(value)
                else:
                    counter += rng.randrange(2)
                    taker = b"%d" % rng.randrange(5)
                    ballot = Ballot(max(1, counter), taker + b"/%d" % len(pending) + b"/%f" % now)
                    tally = Tally(3)
                    for member in members:
                        tally.add(member.claim(ballot, rng.uniform(0.1, 4.0), now) if member in heard else None)
                    outcome = tally.outcome
                    if outcome and outcome.result is Result.WON:
                        pending.append((ballot, outcome.value or ballot.taker))
                if outcome and outcome.result is Result.DECIDED:
                    decided.add(outcome.value or b"")
            self.assertLessEqual(len(decided), 1, f"seed {seed}")


class WireTests(SynchronousTestCase):
    """Behaviour of ``Reply.packed`` and ``reply_unpacked``."""

    @settings(max_examples=100, deadline=None, derandomize=True, database=None)
    @given(reply=REPLIES, accepted=st.none() | st.integers(1, 2**48 - 1), name=st.binary(min_size=1, max_size=40))
    def test_round_trip(self, reply: Reply, accepted: int | None, name: bytes) -> None:
        """Every reply comes back as it was."""
        if accepted is not None:
            reply = Reply(reply.kind, reply.counter, reply.remaining, Ballot(accepted, name), name)
        self.assertEqual(reply_unpacked(reply.packed()), reply)

    @settings(max_examples=300, deadline=None, derandomize=True, database=None)
    @given(foreign=FOREIGN, accepted=FOREIGN)
    def test_total(self, foreign: Any, accepted: Any) -> None:
        """Anything else is None, and never an exception."""
        for fields in (foreign, [0, 1, 0.5, accepted], [0, 1, 0.5, [1, b"a", foreign]], [foreign, 1, 0.5, None]):
            reply = reply_unpacked(fields)
            self.assertTrue(reply is None or isinstance(reply.kind, Kind))

    def test_out_of_range(self) -> None:
        """Numbers and names that cannot be are refused."""
        for fields in (
            [9, 1, 0.5, None], [True, 1, 0.5, None], [0, -1, 0.5, None], [0, 1, 601.0, None],
            [0, 1, float("nan"), None], [0, 1, 1, None], [0, 1, 0.5, [1, b"a"]],
            [0, 1, 0.5, [0, b"a", b"b"]], [0, 1, 0.5, [1, b"", b"b"]],
            [0, 1, 0.5, [1, b"a", b"b" * 41]], [0, 1, 0.5],
        ):  # fmt: skip
            self.assertIsNone(reply_unpacked(fields), fields)
