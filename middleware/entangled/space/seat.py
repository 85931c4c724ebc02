"""The acceptor of a node for takes of tuples: answers claims, confirmations and releases.

It stores its votes as notes in the node's store, so they survive a restart.  A node without notes starts with a new
incarnation.  Tuples name the incarnation of each member, so a member that lost its votes does not vote about tuples
that it may have voted on before.
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
from middleware.entangled.quorum.acceptor import Acceptor, Event, Terms
from middleware.entangled.quorum.ballot import FIRST, NONE, Ballot
from middleware.entangled.quorum.log import MAX_REGISTERS, Log
from middleware.entangled.quorum.register import Kind, Register, Reply
from middleware.entangled.record import KEY_BYTES
from middleware.entangled.space.posting import INCARNATION_BYTES, Place, Posted, is_name, place_unpacked, posting
from middleware.entangled.space.take_codec import CODEC, MAX_LEASE, is_counter, pack_reply

MAX_PLACES = 12
"""Tuples in one request: more would not fit into a datagram."""
UNSETTLED_S = 3.0
"""Seconds after which a member completes a confirmation that it has not seen the end of."""
TERMS = Terms(finish=1.0, must_prepare=True)
_INCARNATION: Final = "decree/incarnation"

Answers = list[object] | Deferred[list[object]]


class Exposing(Protocol):
    """Makes methods callable by peers; ``Endpoint`` implements it."""

    def expose(self, name: str, answer: Callable[..., object], changes: bool = False) -> None:
        """Let peers call ``answer(peer, *arguments)`` under ``name``."""


class Seat:
    """The acceptor of one node for all councils that it is a member of.

    ``written`` may be set to a function that returns a Deferred which fires when all notes are on disk; answers then
    wait for it, so that even a power failure loses no vote that was sent.
    """

    def __init__(self, endpoint: Exposing, store: Store, clock: IReactorTime, rng: random.Random) -> None:
        self.written: Callable[[], Deferred[None]] | None = None
        self._store = store
        self._clock = clock
        self._rng = rng
        self._acceptor: Acceptor[Place] | None = None
        self._unsettled: dict[Place, float] = {}
        self._life = b""
        endpoint.expose("decree.enrol", self.answer_enrol)
        endpoint.expose("decree.claim", self.answer_claim, changes=True)
        endpoint.expose("decree.confirm", self.answer_confirm, changes=True)
        endpoint.expose("decree.release", self.answer_release, changes=True)

    def __len__(self) -> int:
        """Return the number of stored votes."""
        return len(self._votes.log)

    @property
    def incarnation(self) -> bytes:
        """The random id of this node's set of votes; it changes if the node loses them."""
        self.sit()
        return self._life

    def sit(self) -> None:
        """Load the votes of an earlier run, or start a new incarnation."""
        if self._acceptor is None:
            self._acceptor = self._load()

    def vote(self, place: Place) -> Register | None:
        """Return this node's vote about the tuple of ``place``, or None."""
        return self._votes.log.get(place)

    def unsettled(self) -> list[Posted]:
        """Return the tuples with a take accepted here that has had no known end for ``UNSETTLED_S`` seconds.

        Each is returned again after ``UNSETTLED_S`` seconds, until ``settle`` is called.
        """
        now = self._clock.seconds()
        late = [place for place, since in self._unsettled.items() if since + UNSETTLED_S <= now]
        found = []
        for place in late:
            record = self._store.slot(place.slot)
            parsed = posting(record) if record is not None else None
            if isinstance(parsed, Posted) and parsed.place == place:
                self._unsettled[place] = now
                found.append(parsed)
            else:
                self.settle(place)  # removed, or stored at other nodes, which complete it
        return found

    def settle(self, place: Place) -> None:
        """Note that the decision about ``place`` is complete."""
        self._unsettled.pop(place, None)

    # -- requests of claimants --------------------------------------------------------------------------------------

    def answer_enrol(self, peer: Contact) -> bytes:
        """ENROL: agree to be a member of councils; return the incarnation."""
        return self.incarnation

    def answer_claim(
        self,
        peer: Contact,
        key: bytes,
        places: list[object],
        incarnation: bytes,
        counter: int,
        taker: bytes,
        lease: float,
    ) -> Answers:
        """CLAIM: promise and lease the ballot for each of ``places`` under ``key``, or reply with the reason."""
        wanted, ballot = self._parse_request(key, places, incarnation, counter, taker)
        if not 0.0 < lease <= MAX_LEASE:
            raise Refused(f"a lease lasts more than 0 and at most {MAX_LEASE:.0f} seconds")
        now = self._clock.seconds()
        return self._answer(Event.PREPARE, [self._prepare(place, ballot, float(lease), now) for place in wanted])

    def answer_confirm(
        self,
        peer: Contact,
        key: bytes,
        places: list[object],
        incarnation: bytes,
        counter: int,
        taker: bytes,
        value: bytes,
    ) -> Answers:
        """CONFIRM: accept ``value`` as the taker of each of ``places`` under the ballot, or reply with the reason."""
        wanted, ballot = self._parse_request(key, places, incarnation, counter, taker)
        if not is_name(value):
            raise Refused("decree.confirm needs the name of a taker")
        now, acceptor = self._clock.seconds(), self._votes
        replies = [acceptor.accept(place, FIRST, ballot, value, now) for place in wanted]
        for place, reply in zip(wanted, replies, strict=True):
            if reply.accepted != NONE:
                self._unsettled.setdefault(place, now)
        return self._answer(Event.ACCEPT, replies)

    def answer_release(
        self, peer: Contact, key: bytes, places: list[object], incarnation: bytes, counter: int, taker: bytes
    ) -> Answers:
        """RELEASE: end the ballot's lease on each of ``places``."""
        wanted, ballot = self._parse_request(key, places, incarnation, counter, taker)
        now = self._clock.seconds()
        replies = [self._votes.release(place, ballot, now) for place in wanted]
        return [pack_reply(reply, Event.RELEASE) for reply in replies]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _parse_request(
        self, key: bytes, places: list[object], incarnation: bytes, counter: int, taker: bytes
    ) -> tuple[list[Place], Ballot]:
        """Check the common arguments of a request; return the tuples and the ballot; raise ``Refused``."""
        if incarnation != self.incarnation:
            raise Refused("this member has lost its votes since it joined that council")
        if len(key) != KEY_BYTES or not 0 < len(places) <= MAX_PLACES:
            raise Refused(f"a request names a key and 1 to {MAX_PLACES} places")
        wanted = [place for place in (place_unpacked(key, fields) for fields in places) if place is not None]
        if len(wanted) < len(places) or len(set(wanted)) < len(wanted):
            raise Refused("a place is an owner, a name and a mark, and a request names each place once")
        if not (is_counter(counter) and is_name(taker)):
            raise Refused("a ballot is a positive number and the name of a taker")
        return wanted, Ballot(counter, taker)

    @property
    def _votes(self) -> Acceptor[Place]:
        self.sit()
        assert self._acceptor is not None
        return self._acceptor

    def _prepare(self, place: Place, ballot: Ballot, lease: float, now: float) -> Reply:
        if self.vote(place) is None and self._is_over(place):
            return Reply(Kind.OUTBID, ballot)
        reply = self._votes.prepare(place, FIRST, ballot, 0.0, now, lease)
        if reply.kind is Kind.QUIET:
            raise Refused(f"this member has room for {MAX_REGISTERS} votes and all are in use; try another tuple")
        return reply

    def _is_over(self, place: Place) -> bool:
        """Return whether the publisher has removed this tuple or reused its slot."""
        record = self._store.slot(place.slot)
        if record is None:
            return False
        parsed = posting(record)
        return not isinstance(parsed, Posted) or parsed.place != place

    def _may_forget(self, place: Place, vote: Register, now: float) -> bool:
        """Return whether a vote is no longer needed: its lease has expired, or its tuple does not exist."""
        return (vote.accepted == NONE and vote.reserved_until <= now) or self._is_over(place)

    def _answer(self, event: Event, replies: list[Reply]) -> Answers:
        packed: list[object] = [pack_reply(reply, event) for reply in replies]
        return packed if self.written is None else self.written().addCallback(lambda _: packed)

    def _load(self) -> Acceptor[Place]:
        now = self._clock.seconds()
        log = Log(self._store, CODEC, self._may_forget, now)
        self._life = self._store.noted(_INCARNATION) or b""
        if len(self._life) != INCARNATION_BYTES or not log.is_whole:
            log.clear()
            self._life = self._rng.randbytes(INCARNATION_BYTES)
            self._store.note(_INCARNATION, self._life)
        self._unsettled = {place: now for place, vote in log.registers.items() if vote.accepted != NONE}
        return Acceptor(log, TERMS)
