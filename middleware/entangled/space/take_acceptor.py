"""The acceptor of a node for takes of tuples: answers claims, confirmations and releases.

The acceptor stores its votes as notes in the node's store, so the votes survive a restart.  A node without notes starts
with a new incarnation.  Each tuple contains the incarnation of each council member, so a member that lost its votes
does not vote again about tuples that it may have voted on.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Final, Protocol

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.contact import Contact
from middleware.entangled.data.store import Store
from middleware.entangled.errors import Refused
from middleware.entangled.quorum.acceptor import Acceptor, AcceptorSettings, Event
from middleware.entangled.quorum.acceptor_log import MAX_REGISTERS, RegisterLog
from middleware.entangled.quorum.ballot import FIRST_CONFIGURATION, NO_BALLOT, Ballot
from middleware.entangled.quorum.register import Register, Reply, ReplyKind
from middleware.entangled.record import KEY_BYTES
from middleware.entangled.space.take_codec import CODEC, MAX_LEASE_S, is_counter, pack_reply
from middleware.entangled.space.tuple_record import (
    INCARNATION_BYTES,
    StoredTuple,
    TupleId,
    is_taker_name,
    parse_record,
    parse_tuple_id,
)

MAX_TUPLES = 12
"""The maximum number of tuples in one request: more would not fit into a datagram."""
UNFINISHED_S = 3.0
"""If a member has not observed the end of a confirmation after this number of seconds, it completes the
confirmation."""
TERMS = AcceptorSettings(completion_s=1.0, must_prepare=True)
_INCARNATION: Final = "decree/incarnation"

Answers = list[object] | Deferred[list[object]]


class MethodRegistry(Protocol):
    """Makes methods callable by peers; ``Endpoint`` implements it."""

    def expose(self, name: str, answer: Callable[..., object], changes: bool = False) -> None:
        """Let peers call ``answer(peer, *arguments)`` under ``name``."""


class TakeAcceptor:
    """The acceptor of one node for all councils of which the node is a member.

    ``wait_for_write`` may be set to a function that returns a Deferred, which fires when all notes are on disk.
    Answers then wait for this Deferred, so even a power failure loses no vote that was sent.
    """

    def __init__(self, endpoint: MethodRegistry, store: Store, clock: IReactorTime, rng: random.Random) -> None:
        self.wait_for_write: Callable[[], Deferred[None]] | None = None
        self._store = store
        self._clock = clock
        self._rng = rng
        self._acceptor: Acceptor[TupleId] | None = None
        self._unfinished: dict[TupleId, float] = {}
        self._incarnation = b""
        endpoint.expose("decree.enrol", self.answer_enrol)
        endpoint.expose("decree.claim", self.answer_claim, changes=True)
        endpoint.expose("decree.confirm", self.answer_confirm, changes=True)
        endpoint.expose("decree.release", self.answer_release, changes=True)

    def __len__(self) -> int:
        """Return the number of stored votes."""
        return len(self._loaded_acceptor.log)

    @property
    def incarnation(self) -> bytes:
        """The random id of this node's set of votes; it changes if the node loses the votes."""
        self.load()
        return self._incarnation

    def load(self) -> None:
        """Load the votes of an earlier run, or start a new incarnation."""
        if self._acceptor is None:
            self._acceptor = self._load()

    def find_vote(self, tuple_id: TupleId) -> Register | None:
        """Return this node's vote about the tuple ``tuple_id``, or None."""
        return self._loaded_acceptor.log.get(tuple_id)

    def list_unfinished(self) -> list[StoredTuple]:
        """Return the tuples whose take this acceptor accepted but has not seen completed for ``UNFINISHED_S`` seconds.

        Each tuple is returned again every ``UNFINISHED_S`` seconds, until ``finish`` is called.
        """
        now = self._clock.seconds()
        late = [tuple_id for tuple_id, since in self._unfinished.items() if since + UNFINISHED_S <= now]
        found = []
        for tuple_id in late:
            record = self._store.get_slot(tuple_id.slot)
            parsed = parse_record(record) if record is not None else None
            if isinstance(parsed, StoredTuple) and parsed.tuple_id == tuple_id:
                self._unfinished[tuple_id] = now
                found.append(parsed)
            else:
                self.finish(tuple_id)  # the tuple was removed, or is stored at other nodes, which complete it
        return found

    def finish(self, tuple_id: TupleId) -> None:
        """Note that the decision about ``tuple_id`` is complete."""
        self._unfinished.pop(tuple_id, None)

    # -- requests of claimants --------------------------------------------------------------------------------------

    def answer_enrol(self, peer: Contact) -> bytes:
        """Answer ENROL: agree to be a member of councils; return the incarnation."""
        return self.incarnation

    def answer_claim(
        self,
        peer: Contact,
        key: bytes,
        tuple_ids: list[object],
        incarnation: bytes,
        counter: int,
        taker: bytes,
        lease: float,
    ) -> Answers:
        """Answer CLAIM: grant a promise and a lease on each tuple in ``tuple_ids``, or return the reason."""
        wanted, ballot = self._parse_request(key, tuple_ids, incarnation, counter, taker)
        if not 0.0 < lease <= MAX_LEASE_S:
            raise Refused(f"the lease must be more than 0 and at most {MAX_LEASE_S:.0f} seconds")
        now = self._clock.seconds()
        return self._pack_answer(
            Event.PREPARE, [self._prepare(tuple_id, ballot, float(lease), now) for tuple_id in wanted]
        )

    def answer_confirm(
        self,
        peer: Contact,
        key: bytes,
        tuple_ids: list[object],
        incarnation: bytes,
        counter: int,
        taker: bytes,
        value: bytes,
    ) -> Answers:
        """Answer CONFIRM: accept ``value`` as the taker of each tuple in ``tuple_ids``, or say why not."""
        wanted, ballot = self._parse_request(key, tuple_ids, incarnation, counter, taker)
        if not is_taker_name(value):
            raise Refused("decree.confirm: the value must be the name of a taker")
        now, acceptor = self._clock.seconds(), self._loaded_acceptor
        replies = [acceptor.accept(tuple_id, FIRST_CONFIGURATION, ballot, value, now) for tuple_id in wanted]
        for tuple_id, reply in zip(wanted, replies, strict=True):
            if reply.accepted != NO_BALLOT:
                self._unfinished.setdefault(tuple_id, now)
        return self._pack_answer(Event.ACCEPT, replies)

    def answer_release(
        self, peer: Contact, key: bytes, tuple_ids: list[object], incarnation: bytes, counter: int, taker: bytes
    ) -> Answers:
        """Answer RELEASE: end the ballot's lease on each tuple in ``tuple_ids``."""
        wanted, ballot = self._parse_request(key, tuple_ids, incarnation, counter, taker)
        now = self._clock.seconds()
        replies = [self._loaded_acceptor.release(tuple_id, ballot, now) for tuple_id in wanted]
        return [pack_reply(reply, Event.RELEASE) for reply in replies]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _parse_request(
        self, key: bytes, tuple_ids: list[object], incarnation: bytes, counter: int, taker: bytes
    ) -> tuple[list[TupleId], Ballot]:
        """Check the common arguments of a request and return the tuple ids and the ballot; raise ``Refused``."""
        if incarnation != self.incarnation:
            raise Refused("this member has lost its votes since it joined the council of the tuple; try another tuple")
        if len(key) != KEY_BYTES or not 0 < len(tuple_ids) <= MAX_TUPLES:
            raise Refused(f"the request must contain a key and 1 to {MAX_TUPLES} tuple ids")
        wanted = [
            tuple_id for tuple_id in (parse_tuple_id(key, fields) for fields in tuple_ids) if tuple_id is not None
        ]
        if len(wanted) < len(tuple_ids) or len(set(wanted)) < len(wanted):
            raise Refused(
                "a tuple id must consist of an owner, a name and a mark, and must not occur twice in a request"
            )
        if not (is_counter(counter) and is_taker_name(taker)):
            raise Refused("the ballot must consist of a positive number and the name of a taker")
        return wanted, Ballot(counter, taker)

    @property
    def _loaded_acceptor(self) -> Acceptor[TupleId]:
        self.load()
        assert self._acceptor is not None
        return self._acceptor

    def _prepare(self, tuple_id: TupleId, ballot: Ballot, lease: float, now: float) -> Reply:
        if self.find_vote(tuple_id) is None and self._is_over(tuple_id):
            return Reply(ReplyKind.OUTBID, ballot)
        reply = self._loaded_acceptor.prepare(tuple_id, FIRST_CONFIGURATION, ballot, 0.0, now, lease)
        if reply.kind is ReplyKind.QUIET:
            raise Refused(f"this member already stores the maximum of {MAX_REGISTERS} votes; try another tuple")
        return reply

    def _is_over(self, tuple_id: TupleId) -> bool:
        """Return whether the publisher has removed this tuple or reused its slot."""
        record = self._store.get_slot(tuple_id.slot)
        if record is None:
            return False
        parsed = parse_record(record)
        return not isinstance(parsed, StoredTuple) or parsed.tuple_id != tuple_id

    def _may_forget(self, tuple_id: TupleId, vote: Register, now: float) -> bool:
        """Return whether a vote is no longer needed: its lease has expired, or the tuple no longer exists."""
        return (vote.accepted == NO_BALLOT and vote.reserved_until <= now) or self._is_over(tuple_id)

    def _pack_answer(self, event: Event, replies: list[Reply]) -> Answers:
        packed: list[object] = [pack_reply(reply, event) for reply in replies]
        return packed if self.wait_for_write is None else self.wait_for_write().addCallback(lambda _: packed)

    def _load(self) -> Acceptor[TupleId]:
        now = self._clock.seconds()
        log = RegisterLog(self._store, CODEC, self._may_forget, now)
        self._incarnation = self._store.get_note(_INCARNATION) or b""
        if len(self._incarnation) != INCARNATION_BYTES or not log.is_complete:
            log.clear()
            self._incarnation = self._rng.randbytes(INCARNATION_BYTES)
            self._store.set_note(_INCARNATION, self._incarnation)
        self._unfinished = {tuple_id: now for tuple_id, vote in log.registers.items() if vote.accepted != NO_BALLOT}
        return Acceptor(log, TERMS)
