"""Seeded bugs: each breaks the library in one place, and a schedule must detect it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred, succeed

from agents import conference
from agents.docket import Docket
from benchmarks.consensus import bidder
from drivers.errors import StaleCommand
from drivers.gate import Gate
from middleware.consensus.lease import charter, lessee
from middleware.consensus.lease.charter import pin
from middleware.consensus.lease.council import Council
from middleware.consensus.lease.lease_codec import pack_members
from middleware.consensus.lease.lessee import Lease, Lessee
from middleware.consensus.strategies import nearest
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Report
from middleware.entangled.contact import Contact
from middleware.entangled.data import schema
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.data.sqlite import SqliteStore
from middleware.entangled.data.writer import Writer
from middleware.entangled.errors import EntangledError
from middleware.entangled.kademlia import overlay
from middleware.entangled.kademlia.overlay import Overlay, Voters
from middleware.entangled.kademlia.roster import Roster
from middleware.entangled.quorum import acceptor as acceptor_
from middleware.entangled.quorum import round as round_
from middleware.entangled.quorum.acceptor import TABLE, Acceptor, Event, Stand, State
from middleware.entangled.quorum.log import Log
from middleware.entangled.quorum.proposer import Result, conclude
from middleware.entangled.quorum.register import Kind, Register, Reply
from middleware.entangled.quorum.round import Round, Tally
from middleware.entangled.record import Record, Slot
from middleware.entangled.replication import owner, reader
from middleware.entangled.replication.handover import Handover
from middleware.entangled.replication.reader import Reader
from middleware.entangled.replication.replica import Replica
from middleware.entangled.space import council as takes
from middleware.entangled.space.keeper import Keeper
from middleware.entangled.space.seat import Seat
from middleware.entangled.space.shelf import Shelf
from middleware.entangled.wire import greeting
from middleware.entangled.wire.greeting import Cookies, Greeter
from middleware.entangled.wire.method import Ledger
from middleware.entangled.wire.session import Session
from sim.team.machine import Machine
from tests.invariants.leases import Leases


async def _nothing(*_: object) -> None:
    return None


def _idle(*_: object) -> None:
    return None


async def _lookup_that_believes(self: Overlay, target: bytes) -> list[Any]:
    for contact in self.nearest(target):
        try:
            answer = await self.ask(contact, "find_node", target)
        except EntangledError:
            continue
        for found in overlay.contacts_of(answer):
            self.proved(found)
    return self.nearest(target)


async def _read_here(self: Reader, key: bytes) -> dict[Slot, Record]:
    return {record.slot: record for record in self._replica.held(key)}


def _voters(targets: Sequence[Contact]) -> Voters:
    return Voters(frozenset(contact.node_id for contact in targets), len(targets))


def _any_answer(answers: dict[bytes, Any], voters: Voters) -> int:
    return len(answers) * 8


_GENUINE = {
    (place, name): getattr(place, name)
    for place, name in [
        (Greeter, "on_who"),
        (Session, "open"),
        (Seat, "_prepare"),
        (Seat, "_load"),
        (Log, "keep"),
        (Acceptor, "release"),
        (Acceptor, "_stand"),
        (Register, "wake"),
        (Tally, "add"),
        (Keeper, "_slot"),
    ]
}


def _won_by_one(tally: Tally) -> Any:
    outcome = conclude(tally)
    lost = outcome.result in (Result.OUTBID, Result.HELD, Result.SILENT)
    return outcome._replace(result=Result.WON) if lost and tally.agreed else outcome


def _claimed_for_ever(self: Seat, place: Any, ballot: Any, lease: float, now: float) -> Any:
    return _GENUINE[Seat, "_prepare"](self, place, ballot, lease + 1e6, now)


def _let_go_as_if_at_rest(self: Lessee, ballot: Any, heirs: Any = ()) -> Any:
    return self.council.let_go(ballot, heirs)


def _released_at_rest(self: Acceptor[Any], key: Any, ballot: Any, now: float, rest: float = 0.0) -> Any:
    return _GENUINE[Acceptor, "release"](self, key, ballot, now)


def _load_without_votes(self: Seat) -> Any:
    acceptor = _GENUINE[Seat, "_load"](self)
    for votes in (acceptor.log.registers, acceptor.log._buckets, self._unsettled):
        votes.clear()
    return acceptor


def _told_what_is_known(self: Shelf, records: list[Record]) -> None:
    self.posted, _ = self._reader.standing(records)


def _greeted_twice(self: Greeter, datagram: bytes, source: Any) -> None:
    for _ in range(2):
        _GENUINE[Greeter, "on_who"](self, datagram, source)


def _never_known(self: Ledger, public: bytes, question: int) -> None:
    return None


def _moved_before_it_is_opened(self: Session, datagram: bytes) -> Any:
    self._highest += 1
    return _GENUINE[Session, "open"](self, datagram)


def _safe_already(self: Writer) -> Deferred[None]:
    return succeed(None)


def _buried_and_forgotten(self: Docket, task_id: str, now: float) -> None:
    self._open.pop(task_id, None)


def _first_come(contacts: Any, rank: Any) -> list[Report]:
    return sorted(contacts, key=rank)


def _numbered_in_a_byte(contacts: Any, rank: Any) -> list[Report]:
    order = _BEST_OF(contacts, rank)
    names = sorted({report.agent for report in contacts})
    return [replace(r, agent=names[(names.index(r.agent) + 128) % 256 - 128]) for r in order]


def _not_a_number_first(contacts: Any, rank: Any) -> list[Report]:
    return sorted(contacts, key=lambda r: (rank(r) >= 0, rank(r), r.agent))


_BEST_OF = nearest.best_of


def _deadline_from_the_answer(self: Lessee, won: Round) -> float:
    return self._clock.seconds() + self.council.ttl * (1.0 - lessee.CLOCK_MARGIN) - self._stop_time


def _deadline_without_the_stop(self: Lessee, won: Round) -> float:
    return won.sent_at + self.council.ttl * (1.0 - lessee.CLOCK_MARGIN)


def _held_for_ever(self: Lessee) -> Lease | None:
    return Lease(self.task_id, self.token, self._held.deadline) if self.token else None


def _closed_and_forgotten(self: Acceptor[Any], *_: Any) -> Reply:
    return Reply(Kind.OVER)


def _only_listens(self: Lessee, asked: Round) -> None:
    return None


def _closest_now(self: Leases, place: int, task_id: str) -> Any:
    near = [n for n in range(self.n) if not {(place, n), (n, place)} & self.radio.cut and self.is_up(n)]
    return pin(self.operator, task_id, tuple(self.contacts[n] for n in near[:3]))


def _forgets_tokens(self: Log[Any], key: Any) -> None:
    register = self.registers[key]
    token, register.token = register.token, 0
    _GENUINE[Log, "keep"](self, key)
    register.token = token


def _admits_lower_tokens(self: Gate, permit: Any, now: float) -> None:
    if permit.deadline <= now:
        raise StaleCommand("late")
    self._token, self._deadline = permit.token, permit.deadline


async def _decided_by_the_new(self: Council, ballot: Any, members: Any, keep: bool) -> Round:
    question = self.configuration, ballot.counter, pack_members(members), self.token, keep
    return await self.round("lease.change", *question, others=members).outcome


def _row(event: Event, stand: Stand, kind: Kind, state: State = State.OPEN) -> list[tuple[Any, str, Any]]:
    """Return a change of the table with another answer in one row."""
    return [(acceptor_, "TABLE", {**TABLE, (state, event, stand): (kind, TABLE[state, event, stand][1])})]


def _wakes_free(self: Register, now: float, lives: int) -> None:
    _GENUINE[Register, "wake"](self, now, lives)
    self.until = self.reserved_until = 0.0


def _any_configuration(self: Acceptor[Any], register: Register, question: Any) -> Any:
    return _GENUINE[Acceptor, "_stand"](self, register, question._replace(configuration=register.configuration))


def _nothing_is_lower(self: Acceptor[Any], register: Register, question: Any) -> Any:
    stand = _GENUINE[Acceptor, "_stand"](self, register, question)
    return Stand.FREE if stand is Stand.LOWER else stand


def _release_ends_nothing(self: Acceptor[Any], *_: Any) -> Reply:
    return Reply(Kind.GRANTED)


def _counted_twice(self: Tally, place: int, reply: Reply | None) -> None:
    for each in (place, (place + 1) % self.size):
        _GENUINE[Tally, "add"](self, each, reply)


def _only_slot(self: Keeper, key: bytes) -> str:
    _GENUINE[Keeper, "_slot"](self, key)
    return "only"


_BUGS: dict[tuple[str, ...], dict[str, list[tuple[Any, str, Any]]]] = {
    ("records",): {
        "tombstone dropped too early": [(owner, "TOMBSTONE_TTL", 3.0)],
        "acknowledged by a minority": [(Overlay, "voters", lambda self, key, targets: _voters(targets[:1]))],
        "lower sequence accepted": [(Record, "beats", lambda self, other: True)],
        "contact entered unchecked": [(Overlay, "lookup", _lookup_that_believes)],
        "no hand-over": [
            (Handover, "_reconcile", _nothing),
            (Handover, "lost", _idle),
            (Handover, "is_sure", lambda self: True),
        ],
        "absent members do not count": [(Overlay, "voters", lambda self, key, targets: _voters(targets))],
        "nothing instead of unavailable": [(Reader, "_confirm_empty", lambda self, answers, voters: [])],
        "signature not checked": [(Replica, "is_lawful", lambda self, record, peer: True)],
        "sure before it has caught up": [(Handover, "is_sure", lambda self: True)],
        "a read from the own store counts as sure": [(Reader, "newest", _read_here)],
        "numbers start again after a restart": [(owner, "SEQUENCE_BLOCK", -(2**40))],
        "the absent are not sought": [(Roster, "absent", lambda self: [])],
        "any answer counts": [(reader, "_votes", _any_answer)],
    },
    ("tuples",): {
        "one promise is a majority": [(takes, "conclude", _won_by_one)],
        "votes forgotten by a restart": [(Seat, "_load", _load_without_votes)],
        "the lease of the dead never ends": [(Seat, "_prepare", _claimed_for_ever)],
        "a take is not noted": [(Keeper, "note", _nothing), (Keeper, "doubt", _idle)],
        "slots are used too early": [(Keeper, "_slot", _only_slot)],
        "who waits is not woken": [(Shelf, "_changed", _told_what_is_known)],
        "what was accepted is not completed": [(Tally, "to_complete", property(lambda self: None))],
    },
    ("leases",): {
        "lower ballots are accepted": [(Acceptor, "_stand", _nothing_is_lower)],
        "a restart ends leases": [(Register, "wake", _wakes_free)],
        "a lease is granted while another runs": _row(Event.LEASE, Stand.HELD, Kind.GRANTED),
        "a lease is granted before the device rests": _row(Event.LEASE, Stand.ENDING, Kind.GRANTED),
        "a council that is over grants leases": [(Acceptor, "_stand", _any_configuration)],
        "a promise bars nobody": _row(Event.PREPARE, Stand.LOWER, Kind.GRANTED),
        "a release ends nothing": [(Acceptor, "release", _release_ends_nothing)],
        "an answer counts for two members": [(Tally, "add", _counted_twice)],
        "deadline from the time of the answer": [(Lessee, "_deadline_of", _deadline_from_the_answer)],
        "the own deadline is not looked at": [(Lessee, "lease", property(_held_for_ever))],
        "one member of a council is a majority": [(round_, "majority", lambda size: 1)],
        "the end of a task is not kept by its council": [(Acceptor, "close", _closed_and_forgotten)],
        "no clock margin": [(lessee, "CLOCK_MARGIN", 0.0)],
        "a clock that stands still while suspended": [(Machine, "COUNTS_SUSPENSION", False)],
        "the council is whoever is closest now": [(Leases, "council_for", _closest_now)],
        "a stand-by does not ask": [(Lessee, "_schedule_from", _only_listens)],
        "minority grants are kept": [(Lessee, "_release_minority", _idle)],
        "the token is not stored": [(Log, "keep", _forgets_tokens)],
        "the time to stop is ignored": [(Lessee, "_deadline_of", _deadline_without_the_stop)],
        "released before it stands still": [(Lessee, "_send_release", _let_go_as_if_at_rest)],
        "granted before it stands still": [(Acceptor, "release", _released_at_rest)],
        "the device takes lower tokens": [(Gate, "admit", _admits_lower_tokens)],
        "a restarted member grants at once": [(Acceptor, "_silence", lambda self, ttl: 0.0)],
        "the new council decides the change": [
            (Council, "_decision", _decided_by_the_new),
            (charter, "_is_majority", lambda members, signed: True),
        ],
    },
    ("wire",): {
        "questions are not remembered": [(Ledger, "entry", _never_known)],
        "the window moves before the tag is checked": [(Session, "open", _moved_before_it_is_opened)],
        "what was here before is opened again": [(Session, "is_replay", lambda self, datagram: False)],
        "a greeting is answered twice": [(Greeter, "on_who", _greeted_twice)],
        "no cookie is asked for": [(greeting, "QUIET_RATE", 1e6), (Cookies, "admits", lambda *_: True)],
    },
    ("records", "stores"): {
        "acknowledged before it is written": [(Writer, "written", _safe_already)],
        "checksums are not looked at": [(schema, "record_of", lambda row: schema._unchecked(row))],
        "a full disk takes records": [(SqliteStore, "put", MemoryStore.put)],
    },
    ("tasks",): {
        "the end of a task is forgotten": [(Docket, "bury", _buried_and_forgotten)],
        "a little better is enough": [(Nearest, "improves", lambda self, held, offer, _: offer.cost < held.cost)],
        "old rounds count": [(conference, "is_older", lambda told, known: False)],
    },
    ("deciders",): {
        "no tie-break": [(nearest, "best_of", _first_come)],
        "agents are numbered in a byte": [(nearest, "best_of", _numbered_in_a_byte)],
        "a cost that is not a number wins": [(nearest, "best_of", _not_a_number_first)],
        "bidders stop after one quiet round": [(bidder, "is_over", lambda rounds, quiet, tasks, members: quiet >= 1)],
    },
}
"""The seeded bugs, by the workloads that detect them."""
BUGS = {name: changes for bugs in _BUGS.values() for name, changes in bugs.items()}
FINDERS = {name: finders for finders, bugs in _BUGS.items() for name in bugs}


@contextmanager
def seeded(name: str | None) -> Iterator[None]:
    """Apply the seeded bug ``name`` to the library, or none."""
    changes = BUGS[name] if name else []
    kept = [(place, attribute, getattr(place, attribute)) for place, attribute, _ in changes]
    for place, attribute, broken in changes:
        setattr(place, attribute, broken)
    try:
        yield
    finally:
        for place, attribute, genuine in kept:
            setattr(place, attribute, genuine)
