"""Seeded bugs: each bug breaks the library in one place, and the schedules must detect it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred, succeed

from agents import decider
from agents.task_queue import TaskQueue
from benchmarks.consensus import bidder
from drivers.errors import StaleCommand
from drivers.gate import Gate
from middleware.consensus.lease import charter, lease_client
from middleware.consensus.lease.charter import create_charter
from middleware.consensus.lease.lease_client import Lease, LeaseClient
from middleware.consensus.lease.lease_codec import pack_members
from middleware.consensus.lease.lease_proposer import LeaseProposer
from middleware.consensus.strategies import nearest
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Report
from middleware.entangled.contact import Contact
from middleware.entangled.data import schema
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.data.sqlite import SqliteStore
from middleware.entangled.data.writer_thread import Writer
from middleware.entangled.errors import EntangledError
from middleware.entangled.kademlia import overlay
from middleware.entangled.kademlia.member_table import MemberTable
from middleware.entangled.kademlia.overlay import Overlay, Voters
from middleware.entangled.quorum import acceptor as acceptor_
from middleware.entangled.quorum import round as round_
from middleware.entangled.quorum.acceptor import TABLE, Acceptor, BallotRelation, Event, State
from middleware.entangled.quorum.acceptor_log import RegisterLog
from middleware.entangled.quorum.proposer import Result, conclude
from middleware.entangled.quorum.register import Register, Reply, ReplyKind
from middleware.entangled.quorum.round import Round, Tally
from middleware.entangled.record import Record, Slot
from middleware.entangled.replication import owner, reader
from middleware.entangled.replication.handover import Handover
from middleware.entangled.replication.reader import Reader
from middleware.entangled.replication.replica import Replica
from middleware.entangled.space import take_proposer as takes
from middleware.entangled.space.slot_maintenance import SlotMaintenance
from middleware.entangled.space.take_acceptor import TakeAcceptor
from middleware.entangled.space.tuple_cache import TupleCache
from middleware.entangled.wire import discovery
from middleware.entangled.wire.discovery import CookieCheck, Discoverer
from middleware.entangled.wire.method import RequestHistory
from middleware.entangled.wire.session import Session
from sim.team.machine import Machine
from tests.invariants.leases import Leases


async def _nothing(*_: object) -> None:
    return None


def _idle(*_: object) -> None:
    return None


async def _lookup_that_believes(self: Overlay, target: bytes) -> list[Any]:
    for contact in self.find_nearest(target):
        try:
            answer = await self.ask(contact, "find_node", target)
        except EntangledError:
            continue
        for found in overlay.parse_contacts(answer):
            self.mark_authenticated(found)
    return self.find_nearest(target)


async def _read_here(self: Reader, key: bytes) -> dict[Slot, Record]:
    return {record.slot: record for record in self._replica.get_held(key)}


def _voters(targets: Sequence[Contact]) -> Voters:
    return Voters(frozenset(contact.node_id for contact in targets), len(targets))


def _any_answer(answers: dict[bytes, Any], voters: Voters) -> int:
    return len(answers) * 8


_GENUINE = {
    (place, name): getattr(place, name)
    for place, name in [
        (Discoverer, "on_discovery"),
        (Session, "open"),
        (TakeAcceptor, "_prepare"),
        (TakeAcceptor, "_load"),
        (RegisterLog, "write"),
        (Acceptor, "release"),
        (Acceptor, "_find_relation"),
        (Register, "restart_leases"),
        (Tally, "add"),
        (SlotMaintenance, "_take_slot"),
    ]
}


def _won_by_one(tally: Tally) -> Any:
    outcome = conclude(tally)
    lost = outcome.result in (Result.OUTBID, Result.HELD, Result.SILENT)
    return outcome._replace(result=Result.WON) if lost and tally.agreeing_places else outcome


def _claimed_for_ever(self: TakeAcceptor, place: Any, ballot: Any, lease: float, now: float) -> Any:
    return _GENUINE[TakeAcceptor, "_prepare"](self, place, ballot, lease + 1e6, now)


def _let_go_as_if_at_rest(self: LeaseClient, ballot: Any, heirs: Any = ()) -> Any:
    return self.proposer.release(ballot, heirs)


def _released_at_rest(self: Acceptor[Any], key: Any, ballot: Any, now: float, rest: float = 0.0) -> Any:
    return _GENUINE[Acceptor, "release"](self, key, ballot, now)


def _load_without_votes(self: TakeAcceptor) -> Any:
    acceptor = _GENUINE[TakeAcceptor, "_load"](self)
    for votes in (acceptor.log.registers, acceptor.log._buckets, self._unfinished):
        votes.clear()
    return acceptor


def _told_what_is_known(self: TupleCache, records: list[Record]) -> None:
    self.tuples, _ = self._parser.parse(records)


def _greeted_twice(self: Discoverer, datagram: bytes, source: Any) -> None:
    for _ in range(2):
        _GENUINE[Discoverer, "on_discovery"](self, datagram, source)


def _never_known(self: RequestHistory, public: bytes, question: int) -> None:
    return None


def _moved_before_it_is_opened(self: Session, datagram: bytes) -> Any:
    self._highest += 1
    return _GENUINE[Session, "open"](self, datagram)


def _safe_already(self: Writer) -> Deferred[None]:
    return succeed(None)


def _buried_and_forgotten(self: TaskQueue, task_id: str, now: float) -> None:
    self._open.pop(task_id, None)


def _first_come(contacts: Any, rank: Any) -> list[Report]:
    return sorted(contacts, key=rank)


def _numbered_in_a_byte(contacts: Any, rank: Any) -> list[Report]:
    order = _BEST_OF(contacts, rank)
    names = sorted({report.agent for report in contacts})
    return [replace(r, agent=names[(names.index(r.agent) + 128) % 256 - 128]) for r in order]


def _not_a_number_first(contacts: Any, rank: Any) -> list[Report]:
    return sorted(contacts, key=lambda r: (rank(r) >= 0, rank(r), r.agent))


_BEST_OF = nearest.select_best


def _deadline_from_the_answer(self: LeaseClient, won: Round) -> float:
    return self._clock.seconds() + self.proposer.ttl * (1.0 - lease_client.CLOCK_MARGIN) - self._stop_time


def _deadline_without_the_stop(self: LeaseClient, won: Round) -> float:
    return won.sent_at + self.proposer.ttl * (1.0 - lease_client.CLOCK_MARGIN)


def _held_for_ever(self: LeaseClient) -> Lease | None:
    return Lease(self.task_id, self.token, self._held.deadline) if self.token else None


def _closed_and_forgotten(self: Acceptor[Any], *_: Any) -> Reply:
    return Reply(ReplyKind.OVER)


def _only_listens(self: LeaseClient, asked: Round) -> None:
    return None


def _closest_now(self: Leases, place: int, task_id: str) -> Any:
    near = [n for n in range(self.n) if not {(place, n), (n, place)} & self.radio.cut and self.is_up(n)]
    return create_charter(self.operator, task_id, tuple(self.contacts[n] for n in near[:3]))


def _forgets_tokens(self: RegisterLog[Any], key: Any) -> None:
    register = self.registers[key]
    token, register.token = register.token, 0
    _GENUINE[RegisterLog, "write"](self, key)
    register.token = token


def _admits_lower_tokens(self: Gate, permit: Any, now: float) -> None:
    if permit.deadline <= now:
        raise StaleCommand("late")
    self._token, self._deadline = permit.token, permit.deadline


async def _decided_by_the_new(self: LeaseProposer, ballot: Any, members: Any, keep: bool) -> Round:
    question = self.configuration, ballot.counter, pack_members(members), self.token, keep
    return await self.start_round("lease.change", *question, others=members).outcome


def _row(
    event: Event, relation: BallotRelation, kind: ReplyKind, state: State = State.OPEN
) -> list[tuple[Any, str, Any]]:
    """Return a function that changes one row of the table."""
    return [(acceptor_, "TABLE", {**TABLE, (state, event, relation): (kind, TABLE[state, event, relation][1])})]


def _wakes_free(self: Register, now: float, lives: int) -> None:
    _GENUINE[Register, "restart_leases"](self, now, lives)
    self.lease_until = self.reserved_until = 0.0


def _any_configuration(self: Acceptor[Any], register: Register, question: Any) -> Any:
    return _GENUINE[Acceptor, "_find_relation"](self, register, question._replace(configuration=register.configuration))


def _nothing_is_lower(self: Acceptor[Any], register: Register, question: Any) -> Any:
    relation = _GENUINE[Acceptor, "_find_relation"](self, register, question)
    return BallotRelation.FREE if relation is BallotRelation.LOWER else relation


def _release_ends_nothing(self: Acceptor[Any], *_: Any) -> Reply:
    return Reply(ReplyKind.GRANTED)


def _counted_twice(self: Tally, place: int, reply: Reply | None) -> None:
    for each in (place, (place + 1) % self.size):
        _GENUINE[Tally, "add"](self, each, reply)


def _only_slot(self: SlotMaintenance, key: bytes) -> str:
    _GENUINE[SlotMaintenance, "_take_slot"](self, key)
    return "only"


_BUGS: dict[tuple[str, ...], dict[str, list[tuple[Any, str, Any]]]] = {
    ("records",): {
        "tombstone dropped too early": [(owner, "TOMBSTONE_TTL_S", 3.0)],
        "acknowledged by a minority": [(Overlay, "find_voters", lambda self, key, targets: _voters(targets[:1]))],
        "lower sequence accepted": [(Record, "supersedes", lambda self, other: True)],
        "contact entered unchecked": [(Overlay, "lookup", _lookup_that_believes)],
        "no hand-over": [
            (Handover, "_reconcile", _nothing),
            (Handover, "handle_lost_contact", _idle),
            (Handover, "is_synced", lambda self: True),
        ],
        "absent members do not count": [(Overlay, "find_voters", lambda self, key, targets: _voters(targets))],
        "nothing instead of unavailable": [(Reader, "_confirm_empty", lambda self, answers, voters: [])],
        "signature not checked": [(Replica, "may_accept", lambda self, record, peer: True)],
        "sure before it has caught up": [(Handover, "is_synced", lambda self: True)],
        "a read from the own store counts as sure": [(Reader, "read_newest", _read_here)],
        "numbers start again after a restart": [(owner, "SEQUENCE_BLOCK", -(2**40))],
        "the absent are not sought": [(MemberTable, "list_absent", lambda self: [])],
        "any answer counts": [(reader, "_count_votes", _any_answer)],
    },
    ("tuples",): {
        "one promise is a majority": [(takes, "conclude", _won_by_one)],
        "votes forgotten by a restart": [(TakeAcceptor, "_load", _load_without_votes)],
        "the lease of the dead never ends": [(TakeAcceptor, "_prepare", _claimed_for_ever)],
        "a take is not noted": [
            (SlotMaintenance, "put_taken_note", _nothing),
            (SlotMaintenance, "check_taken_note", _idle),
        ],
        "slots are used too early": [(SlotMaintenance, "_take_slot", _only_slot)],
        "who waits is not woken": [(TupleCache, "_on_changed", _told_what_is_known)],
        "what was accepted is not completed": [(Tally, "value_to_complete", property(lambda self: None))],
    },
    ("leases",): {
        "lower ballots are accepted": [(Acceptor, "_find_relation", _nothing_is_lower)],
        "a restart ends leases": [(Register, "restart_leases", _wakes_free)],
        "a lease is granted while another runs": _row(Event.LEASE, BallotRelation.HELD, ReplyKind.GRANTED),
        "a lease is granted before the device rests": _row(Event.LEASE, BallotRelation.ENDING, ReplyKind.GRANTED),
        "a council that is over grants leases": [(Acceptor, "_find_relation", _any_configuration)],
        "a promise bars nobody": _row(Event.PREPARE, BallotRelation.LOWER, ReplyKind.GRANTED),
        "a release ends nothing": [(Acceptor, "release", _release_ends_nothing)],
        "an answer counts for two members": [(Tally, "add", _counted_twice)],
        "deadline from the time of the answer": [(LeaseClient, "_compute_deadline", _deadline_from_the_answer)],
        "the own deadline is not looked at": [(LeaseClient, "lease", property(_held_for_ever))],
        "one member of a council is a majority": [(round_, "majority", lambda size: 1)],
        "the end of a task is not kept by its council": [(Acceptor, "close", _closed_and_forgotten)],
        "no clock margin": [(lease_client, "CLOCK_MARGIN", 0.0)],
        "a clock that stands still while suspended": [(Machine, "COUNTS_SUSPENSION", False)],
        "the council is whoever is closest now": [(Leases, "get_charter", _closest_now)],
        "a stand-by does not ask": [(LeaseClient, "_schedule_from", _only_listens)],
        "minority grants are kept": [(LeaseClient, "_release_minority", _idle)],
        "the token is not stored": [(RegisterLog, "write", _forgets_tokens)],
        "the time to stop is ignored": [(LeaseClient, "_compute_deadline", _deadline_without_the_stop)],
        "released before it stands still": [(LeaseClient, "_send_release", _let_go_as_if_at_rest)],
        "granted before it stands still": [(Acceptor, "release", _released_at_rest)],
        "the device takes lower tokens": [(Gate, "admit", _admits_lower_tokens)],
        "a restarted member grants at once": [(Acceptor, "_quiet_until", lambda self, ttl: 0.0)],
        "the new council decides the change": [
            (LeaseProposer, "_run_deciding_round", _decided_by_the_new),
            (charter, "_is_majority", lambda members, signed: True),
        ],
    },
    ("wire",): {
        "questions are not remembered": [(RequestHistory, "get", _never_known)],
        "the window moves before the tag is checked": [(Session, "open", _moved_before_it_is_opened)],
        "what was here before is opened again": [(Session, "is_replay", lambda self, datagram: False)],
        "a greeting is answered twice": [(Discoverer, "on_discovery", _greeted_twice)],
        "no cookie is asked for": [(discovery, "MAX_HANDSHAKES_PER_S", 1e6), (CookieCheck, "admits", lambda *_: True)],
    },
    ("records", "stores"): {
        "acknowledged before it is written": [(Writer, "wait_for_write", _safe_already)],
        "checksums are not looked at": [(schema, "parse_row", lambda row: schema._parse_unchecked(row))],
        "a full disk takes records": [(SqliteStore, "put", MemoryStore.put)],
    },
    ("tasks",): {
        "the end of a task is forgotten": [(TaskQueue, "mark_over", _buried_and_forgotten)],
        "a little better is enough": [(Nearest, "improves", lambda self, held, offer, _: offer.cost < held.cost)],
        "old rounds count": [(decider, "is_older", lambda told, known: False)],
    },
    ("deciders",): {
        "no tie-break": [(nearest, "select_best", _first_come)],
        "agents are numbered in a byte": [(nearest, "select_best", _numbered_in_a_byte)],
        "a cost that is not a number wins": [(nearest, "select_best", _not_a_number_first)],
        "bidders stop after one quiet round": [(bidder, "is_final", lambda rounds, quiet, tasks, members: quiet >= 1)],
    },
}
"""The seeded bugs, by the workloads that detect them."""
BUGS = {name: changes for bugs in _BUGS.values() for name, changes in bugs.items()}
FINDERS = {name: finders for finders, bugs in _BUGS.items() for name in bugs}


@contextmanager
def seeded(name: str | None) -> Iterator[None]:
    """Apply the seeded bug ``name`` to the library, or no bug for None."""
    changes = BUGS[name] if name else []
    kept = [(place, attribute, getattr(place, attribute)) for place, attribute, _ in changes]
    for place, attribute, broken in changes:
        setattr(place, attribute, broken)
    try:
        yield
    finally:
        for place, attribute, original in kept:
            setattr(place, attribute, original)
