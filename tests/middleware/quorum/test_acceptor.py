"""Tests of ``middleware.entangled.quorum.acceptor`` for each row of its state table, and for all reachable states."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.quorum.acceptor import TABLE, BallotRelation, Event, State, find_state
from middleware.entangled.quorum.ballot import FIRST_CONFIGURATION, INITIAL_CEILING, NO_BALLOT
from middleware.entangled.quorum.register import Register, Reply, ReplyKind
from tests.middleware.quorum.members import LEASE, TAKE, TTL, Member, Use

ENDING_AT = 0.9 * TTL
LOW, MID, HIGH, OTHER = LEASE.ballot(1, 0), LEASE.ballot(2, 0), LEASE.ballot(3, 0), LEASE.ballot(2, 1)
HELD_BY_LOW = {"promised": LOW, "holder": LOW, "token": 1, "ttl": TTL, "lease_until": TTL}
HELD_BY_OTHER = {**HELD_BY_LOW, "promised": LEASE.ballot(1, 1), "holder": LEASE.ballot(1, 1)}
RESERVED = {"promised": LEASE.ballot(1, 1), "reserve": TTL, "reserved_until": TTL}
RECIPES: dict[BallotRelation, tuple[dict[str, Any], Any, float, int]] = {
    BallotRelation.BEHIND: ({}, MID, 1.0, FIRST_CONFIGURATION + 1),
    BallotRelation.MOVED: ({"configuration": FIRST_CONFIGURATION + 1}, MID, 1.0, FIRST_CONFIGURATION),
    BallotRelation.HELD: ({**HELD_BY_OTHER, "promised": MID}, MID, 1.0, FIRST_CONFIGURATION),
    BallotRelation.LOWER: ({"promised": OTHER}, LOW, 1.0, FIRST_CONFIGURATION),
    BallotRelation.OVERTAKEN: ({**HELD_BY_LOW, "promised": OTHER}, LOW, ENDING_AT, FIRST_CONFIGURATION),
    BallotRelation.OWN: (HELD_BY_LOW, LOW, 1.0, FIRST_CONFIGURATION),
    BallotRelation.ENDING: (HELD_BY_OTHER, MID, ENDING_AT, FIRST_CONFIGURATION),
    BallotRelation.RESERVED: (RESERVED, MID, 1.0, FIRST_CONFIGURATION),
    BallotRelation.FOREIGN: ({"promised": OTHER}, MID, 1.0, FIRST_CONFIGURATION),
    BallotRelation.FREE: ({"promised": LOW}, MID, 1.0, FIRST_CONFIGURATION),
}
"""For each ballot relation: the fields of the register, the ballot, the time and the configuration."""
GIVEN_BACK = {"promised": MID, "released": HIGH}
"""The fields of a register in which a later ballot than the released ballot was already released."""


class TableTests(SynchronousTestCase):
    def test_every_row(self) -> None:
        """Each combination of state, event and ballot relation gives the reply and the next state in its row."""
        for (state, event, stand), (kind, after) in TABLE.items():
            if state is State.UNKNOWN:
                continue
            member = Member(LEASE)
            fields, ballot, now, configuration = RECIPES[stand]
            if (event, stand) == (Event.RELEASE, BallotRelation.LOWER):
                fields, ballot = GIVEN_BACK, MID
            register = replace(member.acceptor.log.make_register(0.0), **fields)
            if state is State.SEALED:
                register.accepted, register.value = LEASE.ballot(1, 2), LEASE.values[2]
            register.is_closed = state is State.OVER
            member.acceptor.log.add(LEASE.key, register, 0.0)
            token = 1 if stand in (BallotRelation.OWN, BallotRelation.OVERTAKEN) else 2
            if event is Event.LEASE:
                reply = member.lease(ballot, token, now, configuration)
            elif event is Event.ACCEPT:
                reply = member.accept(ballot, LEASE.values[0], now, configuration)
            else:
                is_release = event is Event.RELEASE
                reply = member.release(ballot, now) if is_release else member.prepare(ballot, now, 0.0, configuration)
            self.assertEqual((reply.kind, find_state(register)), (kind, after), (state, event, stand))

    def test_unknown(self) -> None:
        """An unprepared register rejects a release, and an accept that needs a promise, and takes no space."""
        for use in (TAKE, LEASE):
            member = Member(use)
            ballot = use.ballot(1, 0)
            accepts = ReplyKind.UNPREPARED if use.terms.must_prepare else ReplyKind.GRANTED
            self.assertEqual(member.release(ballot, 0.0).kind, ReplyKind.UNPREPARED)
            self.assertEqual(len(member.acceptor.log), 0)
            self.assertEqual(member.accept(ballot, use.values[0], 0.0).kind, accepts)
            self.assertEqual(len(member.acceptor.log), accepts is ReplyKind.GRANTED)
            self.assertEqual(Member(use).prepare(ballot, 0.0).kind, ReplyKind.GRANTED)

    def test_no_row_is_missing(self) -> None:
        """The table has a row for each state, each event and each relation that the ballot can have."""
        found = {stand for _, event, stand in TABLE if event is not Event.RELEASE}
        released = {BallotRelation.FOREIGN, BallotRelation.LOWER, BallotRelation.HELD, BallotRelation.FREE}
        wanted = {(s, e, st) for s in State for e in Event for st in (released if e is Event.RELEASE else found)}
        self.assertEqual(set(TABLE), wanted)
        self.assertEqual(found | released, set(BallotRelation))


class ReachableTests(SynchronousTestCase):
    """Tests of the invariants in all states that a few proposers can reach."""

    def test_take(self) -> None:
        """With two takers and three ballots, promises and acceptances never decrease and never conflict."""
        self.assertGreater(self.explore(TAKE, tuple(self.questions(TAKE))), 300)

    def test_lease(self) -> None:
        """With two holders and restarts there is one lease at a time, no lower token, and no grant after a change."""
        self.assertGreater(self.explore(LEASE, tuple(self.questions(LEASE))), 2000)

    def questions(self, use: Use) -> Iterator[tuple[str, Any, int]]:
        ballots = [use.ballot(number, name) for number in (1, 2) for name in (0, 1)]
        for ballot in ballots:
            yield "prepare", ballot, 0
            yield "accept", ballot, 0
            yield "release", ballot, 0
        if use is TAKE:
            yield "reserve", ballots[0], 0
            yield "reserve", ballots[3], 0
        else:
            for ballot in (*ballots, ballots[2]._replace(counter=ballots[2].counter + 1)):
                for token in (1, 2):
                    yield "lease", ballot, token

    def explore(self, use: Use, questions: tuple[tuple[str, Any, int], ...]) -> int:
        """Send every request in every state that is reachable in five time steps; return the number of states."""
        start = (Member(use).acceptor.log.make_register(0.0), 0)
        states, seen = [start], {self.digest(*start)}
        for register, step in states:
            later = [(register, step + 1)] if step < 4 else []
            for event, ballot, token in questions:
                member, now = Member(use), step * 0.4 * TTL
                after = replace(register, listeners={})
                if register.promised != NO_BALLOT:
                    member.acceptor.log.add(use.key, after, 0.0)
                reply = self.ask(member, event, ballot, token, now)
                after = member.acceptor.log.get(use.key) or after
                self.verify(use, register, after, event, ballot, token, now, reply)
                later.append((after, step))
            for each in later:
                if self.digest(*each) not in seen:
                    seen.add(self.digest(*each))
                    states.append(each)
        return len(states)

    def digest(self, register: Register, step: int) -> tuple[Any, ...]:
        """Return the features by which states are distinguished; all periods that have ended count as equal."""
        now = step * 0.4 * TTL
        told = (
            register.promised,
            register.holder,
            register.released,
            register.accepted,
            register.token,
            register.grantee,
        )
        return (*told, max(0.0, register.lease_until - now), max(0.0, register.reserved_until - now), step)

    def ask(self, member: Member, event: str, ballot: Any, token: int, now: float) -> Reply:
        """Send one request; a value to accept depends on the ballot."""
        match event:
            case "prepare":
                return member.prepare(ballot, now)
            case "reserve":
                return member.prepare(ballot, now, TTL / 2)
            case "lease":
                return member.lease(ballot, token, now)
            case "accept":
                return member.accept(ballot, member.use.values[ballot.counter // member.use.codec.lives], now)
        return member.release(ballot, now, TTL / 4)

    def verify(
        self,
        use: Use,
        before: Register,
        after: Register,
        event: str,
        ballot: Any,
        token: int,
        now: float,
        reply: Reply,
    ) -> None:
        """Check the invariants of one step.

        The labels in the comments are the invariants in ``docs/explanation/quorum.md``.
        """
        case = event, ballot, token, now, before
        lives = use.codec.lives
        is_held = before.lease_until > now and not ballot.is_same_life(before.holder, lives)
        if reply.kind not in (ReplyKind.GRANTED, ReplyKind.SEALED):
            self.assertEqual(self.digest(before, 0), self.digest(after, 0), case)  # a rejection changes nothing
        self.assertGreaterEqual(after.promised, before.promised, case)  # P1: promises never decrease
        self.assertGreaterEqual(after.accepted, before.accepted, case)  # A1: acceptances never decrease
        self.assertGreaterEqual(after.token, before.token, case)  # T1: the token never decreases
        self.assertGreaterEqual(after.released, NO_BALLOT)
        if event == "lease" and reply.kind is ReplyKind.GRANTED:
            self.assertFalse(is_held, case)  # L1: one holder at a time
            self.assertEqual(before.accepted, NO_BALLOT, case)  # C1: no lease in a sealed configuration
            self.assertGreater(ballot, before.released, case)  # B3: no grant to a released ballot
            extends = before.lease_until > now and token == before.token and before.holder > before.released
            # P1: no grant below the promise; L4: except for the extension of a lease
            self.assertTrue(ballot >= before.promised or extends, case)
            # T2: a token belongs to one holder
            self.assertTrue(token > before.token or ballot.is_same_life(before.holder, lives), case)
        if event == "accept" and reply.kind is ReplyKind.GRANTED:
            self.assertFalse(before.lease_until > now, case)  # C2: no acceptance during a lease
            # P1: no grant below the promise; B3: no grant to a released ballot
            self.assertTrue(ballot >= before.promised and ballot > before.released, case)
            # R4: no acceptance before a prepare, if a prepare is required
            self.assertTrue(not use.terms.must_prepare or before.promised != NO_BALLOT, case)
        if event in ("prepare", "reserve") and reply.kind in (ReplyKind.GRANTED, ReplyKind.SEALED):
            self.assertEqual(reply.accepted, before.accepted, case)  # A2: a promise carries the accepted ballot
            self.assertEqual(reply.kind is ReplyKind.SEALED, before.accepted != NO_BALLOT, case)
            is_reserved = before.reserved_until > now and not ballot.is_same_life(before.promised, lives)
            self.assertFalse(is_reserved, case)  # L3: a prepare replaces no exclusive promise
            # L3: no promise to another proposer except near the end of a lease
            self.assertTrue(not is_held or before.is_released or before.lease_until - now <= 0.2 * TTL, case)
        if event != "release":
            self.assertGreaterEqual(after.lease_until, before.lease_until, case)  # L3: only the holder shortens a lease
        elif is_held:
            self.assertEqual(after.lease_until, before.lease_until, case)


class NumberTests(SynchronousTestCase):
    def test_numbers_are_bounded(self) -> None:
        """Ballots and tokens above the ceiling are rejected, so no proposer can use up all numbers (invariant N1)."""
        for use in (TAKE, LEASE):
            member, huge = Member(use), use.ballot(INITIAL_CEILING + 1, 0)
            self.assertEqual(member.prepare(huge, 0.0).kind, ReplyKind.OUTBID)
            self.assertEqual(member.prepare(use.ballot(1, 0), 0.0).kind, ReplyKind.GRANTED)
            self.assertEqual(member.accept(huge, use.values[0], 0.0).kind, ReplyKind.OUTBID)
            self.assertEqual(member.lease(use.ballot(1, 0), INITIAL_CEILING + 1, 0.0).kind, ReplyKind.OUTBID)
            self.assertEqual(member.prepare(huge, 1.0).kind, ReplyKind.GRANTED)

    def test_another_life(self) -> None:
        """A restarted proposer waits for the end of its earlier lease, as invariant L2 requires.

        The device of the proposer may still act under this lease.
        """
        member = Member(LEASE)
        member.lease(LOW, 1, 0.0)
        self.assertEqual(member.prepare(MID, 1.0).kind, ReplyKind.GRANTED)
        self.assertEqual(member.prepare(MID._replace(counter=MID.counter + 1), 1.0).kind, ReplyKind.HELD)

    def test_restart(self) -> None:
        """A restarted acceptor keeps its promises, leases and accepted values (invariants D1 and R2)."""
        for use in (TAKE, LEASE):
            member, first, second = Member(use), use.ballot(1, 0), use.ballot(2, 1)
            member.prepare(second, 0.0)
            member.restart(50.0)
            self.assertEqual(member.prepare(first, 50.0).kind, ReplyKind.OUTBID)
            member.accept(second, use.values[0], 50.0)
            member.restart(99.0)
            told = member.prepare(use.ballot(3, 1), 99.0)
            self.assertEqual((told.kind, told.accepted, told.value), (ReplyKind.SEALED, second, use.values[0]))
        leased = Member(LEASE)
        leased.lease(LOW, 1, 0.0)
        leased.restart(50.0)
        self.assertEqual(leased.prepare(OTHER, 51.0).kind, ReplyKind.HELD)
        reserved = Member(TAKE)
        reserved.prepare(TAKE.ballot(1, 0), 0.0, TTL)
        reserved.restart(50.0)
        self.assertEqual(reserved.prepare(TAKE.ballot(2, 1), 51.0).kind, ReplyKind.HELD)
