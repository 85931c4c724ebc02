"""Tests of the invariant checker with handmade histories: violations of each invariant, and similar valid histories."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from sim.team.checker import PARTS, find_violations
from sim.team.event import (
    ActiveTasks,
    Answered,
    AnswerRepeated,
    Asked,
    Assumptions,
    Born,
    CommandExpected,
    CommandReceived,
    CommandSent,
    ContactKnown,
    Decided,
    Died,
    Event,
    FaultFree,
    InvalidDatagram,
    LeaseHeld,
    LeaseWon,
    LivingMembers,
    MajorityReachable,
    MembersListed,
    OpenTask,
    OutcomeExpired,
    OutcomeStored,
    Report,
    RequestExecuted,
    RobotStopped,
    Settled,
    Stored,
    TableSize,
    TupleStored,
    Unanswered,
    UnvalidatedTraffic,
    VoteAccepted,
)
from sim.team.history import History
from sim.team.invariant.durability import Slot

TERMS = Assumptions(0.0, 1.5, 0.01, 0.3, 0.1)
SLOT = Slot(b"key", b"owner", "a")
OTHER = Slot(b"key", b"owner", "b")
ONE = Born(0.0, 1, 1, b"p1", b"\1", "h:1")
TWO = Born(0.0, 2, 1, b"p2", b"\2", "h:2")
COUNCIL = (b"m1", b"m2", b"m3")
POSTED = TupleStored(0.0, "mark", ("job", 1), COUNCIL, (b"i", b"i", b"i"))
SEATED = LivingMembers(9.0, ((b"m1", b"i"), (b"m2", b"i"), (b"m3", b"other")))
TAKEN = [POSTED, VoteAccepted(1.0, "mark", 1, b"taker", b"m1"), VoteAccepted(1.0, "mark", 1, b"taker", b"m2")]
PUT: list[Event] = [Asked(0.0, 1, 1, "put", ("job", 1)), Answered(0.5, 1)]
SURVEY = Asked(5.0, 9, 2, "survey", "job")


def command(at: float, token: int, is_accepted: bool = True, place: int = 1) -> CommandReceived:
    """Return a command for the task t0 that is valid for one second."""
    return CommandReceived(at, "t0", place, token, is_accepted, at + 1.0, at + 1.0)


def write(at: float, number: int, is_known: bool = True, what: str = "write") -> list[Event]:
    """Return a write of the slot and the acknowledgement of the write."""
    asked = Asked(at, number, 1, what, SLOT, number)
    return [asked, Answered(at + 0.1, number)] if is_known else [asked, Unanswered(at + 0.1, number, "silence")]


def read(at: float, shown: dict[Slot, int], concern: str = "majority") -> list[Event]:
    """Return a read of the slot's key and the result of the read."""
    number = int(at * 1000)
    return [Asked(at, number, (2, 1), "read", b"key", concern), Answered(at + 0.1, number, shown)]


def decided(place: int, assigned: str, cost: float = 1.0, serial: int = 5, holder: str | None = None) -> Decided:
    """Return a decision between the agents a and b; the cost of b is 2."""
    me = Report(str(place), f"dog{place}", 1, 1, None)
    reports = (me, Report("a", "dog-a", 1, serial, cost), Report("b", "dog-b", 1, 5, 2.0))
    return Decided(1.0 + place / 10, place, "t0", reports, ("basis", cost, serial), assigned, holder, 0.1)


def shot(
    after: str = "same", raised: str = "", logged: str = "", answers: tuple[tuple[bool, int], ...] = ()
) -> InvalidDatagram:
    """Return the delivery of a forged datagram of ten bytes."""
    return InvalidDatagram(1.0, 1, "forged", bytes(10), "same", after, raised, logged, answers)


BROKEN: dict[str, list[list[Event]]] = {
    "E1": [
        [TERMS, LeaseWon(1.0, "t0", 1, 5), LeaseWon(2.0, "t0", 2, 5)],
        [TERMS, command(1.0, 5), command(2.0, 4)],
        [TERMS, CommandReceived(3.0, "t0", 1, 1, True, 4.0, 2.0)],
    ],
    "E2": [
        [TERMS, LeaseHeld(1.0, "t0", 1, (2,))],
        [TERMS, command(1.0, 1), LeaseHeld(2.2, "t0", 2)],
    ],
    "E3": [
        [CommandExpected(1.0, "t0", "1 is gone", 3, 1.0, 2.0), command(2.0, 3)],
        [CommandExpected(1.0, "t0", "1 is gone", 3, 1.0, 2.0), command(3.1, 4)],
    ],
    "E4": [
        [Asked(1.0, 1, 0, "submit", "t0"), OpenTask(9.0, "t0", 1, "waiting", False)],
        [Asked(1.0, 1, 0, "submit", "t0"), OutcomeExpired(5.0, "t0"), OpenTask(9.0, "t0", 1, "", True)],
        [OutcomeExpired(5.0, "t0"), ActiveTasks(5.1, 1, ("t0",))],
    ],
    "E5": [
        [Asked(1.0, 1, 1, "close", "t0"), Answered(1.1, 1), command(1.2, 7)],
        [Assumptions(0.0, 1.5, 0.05, 0.3, 0.1), Asked(1.0, 1, 1, "close", "t0"), Answered(1.1, 1), command(1.3, 7)],
        [Asked(1.0, 1, 1, "close", "t0"), Unanswered(1.1, 1, "no majority")],
        [Asked(1.0, 1, 1, "close", "t0")],
        [FaultFree(0.0, 4.0), OutcomeStored(1.0, "t0", "COMPLETED"), ActiveTasks(5.1, 1, ("t0",))],
    ],
    "E6": [[decided(1, "a", 1.9, holder="b")]],
    "E7": [
        [decided(1, "a"), decided(2, "b")],
        [decided(1, "a"), decided(1, "a", serial=4)],
    ],
    "E8": [
        [TERMS, CommandSent(2.0, "t0", 1, 1.9, 1.9)],
        [ActiveTasks(1.0, 1, ("t0", "t1"))],
        [ActiveTasks(1.0, 1, ("t0",), ("t0", "t1"))],
    ],
    "E9": [
        [TERMS, MajorityReachable(1.0, "t0", 1, False), LeaseWon(1.8, "t0", 1, 3)],
        [TERMS, MajorityReachable(1.0, "t0", 1, False), command(2.8, 3)],
    ],
    "D1": [
        [*write(1.0, 1), *read(2.0, {})],
        [*write(1.0, 1), *read(2.0, {}, "fast")],
        [*write(1.0, 1, False), *read(2.0, {SLOT: 1}), *read(3.0, {})],
    ],
    "D2": [[*write(1.0, 1), *write(2.0, 2), *read(3.0, {SLOT: 1})]],
    "D3": [[*write(1.0, 1), *write(2.0, 2, what="remove"), *read(3.0, {SLOT: 1})]],
    "D4": [
        [*write(1.0, 1), *read(2.0, {SLOT: 77777})],
        [Stored(1.0, 1, 0, SLOT, "a", 3, b"s", True, True), Stored(2.0, 1, 0, SLOT, "a", 2, b"s", True, True)],
        [Stored(1.0, 1, 0, SLOT, "a", 3, b"s", True, False)],
        [
            *(*write(0.1, 1, False), Asked(0.2, 2, 1, "write", OTHER, 1)),
            *(Stored(1.0, 1, 0, SLOT, "a", 3, b"s", True, True), Stored(1.0, 1, 0, OTHER, "b", 3, b"t", True, True)),
        ],
    ],
    "D5": [
        [ONE, ContactKnown(1.0, 1, b"ghost", "h:9")],
        [ONE, ContactKnown(1.0, 1, b"p1", "h:1")],
        [ONE, TWO, ContactKnown(1.0, 1, b"p2", "h:9")],
    ],
    "D6": [
        [ONE, TWO, Asked(1.0, 1, 1, "look up", b"\3", 8), Answered(1.1, 1, ())],
        [ONE, TWO, Asked(1.0, 1, 1, "look up", b"\3", 8), Unanswered(1.1, 1, "silence")],
        [ONE, TWO, Asked(1.0, 1, 1, "look up", b"\3", 8)],
    ],
    "D7": [
        [ONE, TWO, MembersListed(1.0, 1, ())],
        [Settled(1.0), Asked(2.0, 1, 1, "read", b"key", "majority"), Unanswered(2.1, 1, "few", True)],
    ],
    "T1": [
        [*TAKEN, VoteAccepted(2.0, "mark", 2, b"other", b"m2"), VoteAccepted(2.0, "mark", 2, b"other", b"m3")],
        [
            *(Asked(1.0, 1, 1, "take", "job"), Answered(1.1, 1, (("job", 1),))),
            *(Asked(2.0, 2, 2, "take", "job"), Answered(2.1, 2, (("job", 1),))),
        ],
    ],
    "T2": [
        [*PUT, SURVEY, Answered(5.1, 9, ())],
        [Settled(1.0), SURVEY, Unanswered(5.1, 9, "silence")],
        [Settled(1.0), Asked(2.0, 1, 1, "ring", "bell")],
    ],
    "T3": [
        [
            *(POSTED, SEATED, Asked(1.0, 1, 1, "take", "job"), Answered(1.1, 1, (("job", 1),))),
            *(SURVEY, Answered(5.1, 9, (("job", 1),))),
        ]
    ],
    "T4": [[AnswerRepeated(1.0, ("job", 1), b"taker", b"other")], [AnswerRepeated(1.0, ("job", 1), b"taker", None)]],
    "T5": [[*PUT, POSTED, Settled(2.0), SEATED]],
    "T6": [
        [Asked(1.0, 1, 1, "wait", "he"), Asked(2.0, 2, 2, "ring", "bell"), Answered(2.1, 2)],
        [Asked(1.0, 1, 1, "wait", "he"), Asked(2.0, 2, 2, "ring", "bell"), Answered(2.1, 2), Answered(3.2, 1)],
    ],
    "R1": [[shot("other")], [shot(raised="KeyError()")], [shot(logged="oh")]],
    "R2": [
        [RequestExecuted(1.0, 1, 1, 7), RequestExecuted(1.1, 1, 1, 7)],
        [Asked(1.0, 1, 2, "run", 7), Answered(1.2, 1, (7, 1, 1, 1))],
        [Asked(1.0, 1, 2, "run", 7), RequestExecuted(1.1, 1, 1, 7), Answered(1.2, 1, (8, 1, 1, 1))],
    ],
    "R3": [[shot(answers=((True, 11),))], [shot(answers=((False, 1),))], [UnvalidatedTraffic(1.0, 11, 10)]],
    "R4": [[TableSize(1.0, 1, "peers", 11, 10)]],
}
"""For each invariant, histories that violate this invariant and no other."""

LAWFUL: dict[str, list[Event]] = {
    "tokens grow, and a refused command harms nobody": [
        TERMS,
        command(1.0, 5),
        command(2.0, 4, False),
        command(3.0, 6),
    ],
    "members that forget may grant a lower token": [
        TERMS,
        LeaseWon(1.0, "t0", 1, 5),
        Died(1.5, 3, True),
        LeaseWon(2.0, "t0", 2, 1),
    ],
    "a robot that was told to stop has come to rest": [
        TERMS,
        command(1.0, 1),
        RobotStopped(1.5, "t0", 1, 1.8),
        LeaseHeld(1.9, "t0", 2),
    ],
    "clocks that are further off may overlap": [Assumptions(0.0, 1.5, 0.05, 0.0, 0.1), LeaseHeld(1.0, "t0", 1, (2,))],
    "another acts in time": [CommandExpected(1.0, "t0", "1 is gone", 3, 1.0, 2.0), command(2.9, 4)],
    "who is reached again may win": [
        TERMS,
        MajorityReachable(1.0, "t0", 1, False),
        MajorityReachable(2.0, "t0", 1, True),
        LeaseWon(4.0, "t0", 1, 3),
    ],
    "a write that nobody acknowledged may be absent": [*write(1.0, 1, False), *read(2.0, {})],
    "and it may be there": [*write(1.0, 1, False), *read(2.0, {SLOT: 1})],
    "a fast read may show an older value": [*write(1.0, 1), *write(2.0, 2), *read(3.0, {SLOT: 1}, "fast")],
    "a removal under way may be the newest": [*write(1.0, 1), *write(2.0, 2, False, "remove"), *read(3.0, {})],
    "what is acknowledged during a read need not be in it": [
        *(Asked(1.0, 90, (2, 1), "read", b"key", "majority"), *write(1.1, 1), Answered(1.3, 90, {})),
    ],
    "another life has read nothing yet": [
        *write(1.0, 1, False),
        *read(2.0, {SLOT: 1}),
        *(Asked(3.0, 91, (2, 2), "read", b"key", "majority"), Answered(3.1, 91, {})),
    ],
    "a read may fail while faults last": [
        Asked(2.0, 1, 1, "read", b"key", "majority"),
        Unanswered(2.1, 1, "few", True),
    ],
    "the dead are not counted": [ONE, TWO, Died(1.0, 2), MembersListed(2.0, 1, ())],
    "a take that is not confirmed may have happened": [
        *TAKEN,
        *(Asked(1.0, 5, 1, "take", "job"), Unanswered(2.0, 5, "silence"), *PUT, SURVEY, Answered(5.1, 9, ())),
    ],
    "votes of two ballots do not add up": [
        *(POSTED, VoteAccepted(1.0, "mark", 1, b"taker", b"m1"), VoteAccepted(2.0, "mark", 2, b"taker", b"m2")),
        *(VoteAccepted(3.0, "mark", 3, b"other", b"m2"), VoteAccepted(3.0, "mark", 3, b"other", b"m3")),
    ],
    "a council that has forgotten cannot decide": [*PUT, POSTED, Settled(2.0), LivingMembers(9.0, ((b"m1", b"i"),))],
    "who died waits no more": [
        *(Asked(1.0, 1, 1, "wait", "he"), Unanswered(1.5, 1, "it died")),
        *(Asked(2.0, 2, 2, "ring", "bell"), Answered(2.1, 2)),
    ],
    "another life may run a question again": [RequestExecuted(1.0, 1, 1, 7), RequestExecuted(2.0, 1, 2, 7)],
    "an answer as long as the question": [
        shot(answers=((True, 10),)),
        UnvalidatedTraffic(1.0, 10, 10),
        TableSize(1.0, 1, "peers", 10, 10),
    ],
    "of other reports another may be named": [decided(1, "a"), decided(2, "b", 2.5)],
}
"""Valid histories that resemble violations of an invariant."""


class CheckerTests(SynchronousTestCase):
    def test_each_is_broken_alone(self) -> None:
        """Each history in ``BROKEN`` violates its own invariant and no other invariant."""
        for name, histories in BROKEN.items():
            for history in histories:
                found = {line.partition(":")[0] for line in find_violations(history)}
                self.assertEqual(found, {name}, history)

    def test_none_is_forgotten(self) -> None:
        """``BROKEN`` has a history for every invariant of the checker."""
        self.assertEqual({name for _, invariants in PARTS for name, _ in invariants}, set(BROKEN))

    def test_lawful(self) -> None:
        """Valid histories that resemble violations pass."""
        self.assertEqual({why: found for why, history in LAWFUL.items() if (found := find_violations(history))}, {})

    def test_no_line_twice(self) -> None:
        """A violation that occurs several times in the same way is reported once."""
        self.assertEqual(len(find_violations([TERMS, *[LeaseHeld(1.0, "t0", 1, (2,))] * 3])), 1)


class HistoryTests(SynchronousTestCase):
    def made(self, result: object) -> History:
        """Return a history with one operation."""
        moments = iter([1.0, 2.0, 2.5])
        history = History(lambda: next(moments))
        number = history.record_request("client", "put", ("job", 1))
        history.record(Died, 3)
        history.record_answer(number, result)
        return history

    def test_order(self) -> None:
        """A history lists the events in the order of their times."""
        wanted = [Asked(1.0, 1, "client", "put", ("job", 1)), Died(2.0, 3), Answered(2.5, 1, "done")]
        self.assertEqual(list(self.made("done")), wanted)

    def test_digest(self) -> None:
        """Equal histories have equal digests; a different result changes the digest."""
        self.assertEqual(self.made("done").digest(), self.made("done").digest())
        self.assertNotEqual(self.made("done").digest(), self.made("not done").digest())
