"""Record every vote of every council member of a tuple space, including restarted members, for the checker."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any

from twisted.internet.defer import maybeDeferred

from middleware.entangled.contact import Contact
from middleware.entangled.node import EntangledNode
from middleware.entangled.quorum.acceptor import Event
from middleware.entangled.quorum.ballot import NO_BALLOT
from middleware.entangled.quorum.register import Reply, ReplyKind
from middleware.entangled.record import Record
from middleware.entangled.space.take_acceptor import TakeAcceptor
from middleware.entangled.space.take_codec import unpack_reply
from middleware.entangled.space.tuple_record import StoredTuple, TupleId, parse_record, parse_tuple_id
from sim.team import event
from sim.team.history import History

INCARNATION = "decree/incarnation"
"""The note in which a council member stores its incarnation."""


class VoteRecorder:
    """Records every acceptance of every council member, before and after restarts."""

    def __init__(self, history: History) -> None:
        self._history = history
        self.tuples: dict[TupleId, StoredTuple] = {}
        self.votes: dict[TupleId, dict[tuple[int, bytes, bytes], set[bytes]]] = defaultdict(lambda: defaultdict(set))

    def record_tuple(self, record: Record) -> None:
        """Record a tuple that a replica stores."""
        content = parse_record(record)
        if isinstance(content, StoredTuple):
            if content.tuple_id not in self.tuples:
                members = [(member.contact.public, member.incarnation) for member in content.council]
                self._history.record(
                    event.TupleStored, content.tuple_id, content.fields, *map(tuple, zip(*members, strict=True))
                )
            self.tuples[content.tuple_id] = content

    def wrap_member(self, acceptor: TakeAcceptor, expose: Callable[..., object], member: bytes) -> None:
        """Wrap the answers of the council member ``member`` to record the takes that it accepts."""
        confirm: Callable[..., Any] = acceptor.answer_confirm
        claim: Callable[..., Any] = acceptor.answer_claim

        def parse_answers(
            asked: Event, key: bytes, places: list[object], answers: list[object]
        ) -> list[tuple[TupleId, Reply]]:
            pairs = [(parse_tuple_id(key, p), unpack_reply(a, asked)) for p, a in zip(places, answers, strict=True)]
            return [(place, reply) for place, reply in pairs if place is not None and reply is not None]

        def confirmed(peer: Contact, key: bytes, places: list[object], incarnation: bytes, *ballot: Any) -> Any:
            def note_accepted(answers: list[object]) -> list[object]:
                for place, reply in parse_answers(Event.ACCEPT, key, places, answers):
                    if reply.kind is ReplyKind.GRANTED:
                        self.record_vote(place, ballot, member)
                return answers

            return maybeDeferred(confirm, peer, key, places, incarnation, *ballot).addCallback(note_accepted)

        def claimed(peer: Contact, key: bytes, places: list[object], *rest: Any) -> Any:
            def note_accepted(answers: list[object]) -> list[object]:
                # A member with a full disk reports an acceptance only with a later answer.
                for place, reply in parse_answers(Event.PREPARE, key, places, answers):
                    if reply.accepted != NO_BALLOT:
                        self.record_vote(place, (*reply.accepted, reply.value), member)
                return answers

            return maybeDeferred(claim, peer, key, places, *rest).addCallback(note_accepted)

        acceptor.answer_confirm, acceptor.answer_claim = confirmed, claimed  # type: ignore[method-assign, assignment]
        expose("decree.confirm", confirmed, changes=True)
        expose("decree.claim", claimed, changes=True)

    def record_vote(self, place: TupleId, ballot: tuple[int, bytes, bytes], member: bytes) -> None:
        """Record an acceptance of a council member."""
        if member not in self.votes[place][ballot]:
            self._history.record(event.VoteAccepted, place, ballot[:2], ballot[2], member)
        self.votes[place][ballot].add(member)

    def record_members(self, nodes: Iterable[EntangledNode]) -> None:
        """Record the living members and their incarnations without requests, which would start the acceptors."""
        members = [
            (node.identity.public, node.take_acceptor._incarnation or node.store.get_note(INCARNATION) or b"")
            for node in nodes
        ]
        self._history.record(event.LivingMembers, tuple(members))

    def find_takers(self, place: TupleId) -> set[bytes]:
        """Return all takers that a majority of the council has ever accepted; more than one taker is a violation."""
        quorum = len(self.tuples[place].council) // 2 + 1
        return {value for (_, _, value), members in self.votes[place].items() if len(members) >= quorum}

    def list_undecided(self) -> list[StoredTuple]:
        """Return the tuples without a taker accepted by a majority."""
        return [stored_tuple for place, stored_tuple in self.tuples.items() if not self.find_takers(place)]
