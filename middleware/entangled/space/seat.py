"""Seat: what a node does as a member of councils; it votes, remembers how it voted, and decides nothing.

Votes are kept as notes in the node's store, so they survive a restart.  A node that finds none starts a new life with
a new incarnation: tuples name the incarnation that they count upon, so a member that has lost its memory keeps silent
about everything it may have voted on before.
"""

from __future__ import annotations

import hashlib
import random
from collections.abc import Callable
from typing import Any, Final, Protocol

import msgpack
from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.data.store import Store
from middleware.entangled.errors import Refused
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.record import KEY_BYTES
from middleware.entangled.space.decree import MAX_LEASE, Ballot, Kind, Reply, State, Vote, is_counter, is_name
from middleware.entangled.space.posting import INCARNATION_BYTES, Place, Posted, place_unpacked, posting

MAX_VOTES = 4096
MAX_PLACES = 12
"""Decrees in one question: more would not fit into a datagram."""
UNSETTLED = 3.0
"""Seconds after which a member looks after a confirmation of which it has not heard the end."""
LOOKED_AT = 256
"""The oldest votes that are looked at when there is no room for a new one; all of them would take too long."""
_INCARNATION: Final = "decree/incarnation"
_FLOOR: Final = "decree/floor"
_BUCKETS = 256

Answers = list[object] | Deferred[list[object]]


class Exposing(Protocol):
    """What lets peers call a method; an ``Endpoint`` does."""

    def expose(self, name: str, answer: Callable[..., object], changes: bool = False) -> None:
        """Let peers call ``answer(peer, *arguments)`` under ``name``."""


class Seat:
    """A node's seat in every council that it is called to.

    ``written`` may be set to a callable whose Deferred fires when everything noted so far is on disk; answers then wait
    for it, and not even a loss of power can make the node forget what it has said.
    """

    def __init__(self, endpoint: Exposing, store: Store, clock: IReactorTime, rng: random.Random) -> None:
        self.written: Callable[[], Deferred[None]] | None = None
        self._store = store
        self._clock = clock
        self._rng = rng
        self._votes: dict[Place, Vote] = {}
        self._buckets: dict[int, dict[Place, None]] = {}
        self._unsettled: dict[Place, float] = {}
        self._life = b""
        self._floor = 0
        endpoint.expose("decree.enrol", self.answer_enrol)
        endpoint.expose("decree.claim", self.answer_claim, changes=True)
        endpoint.expose("decree.confirm", self.answer_confirm, changes=True)
        endpoint.expose("decree.release", self.answer_release, changes=True)

    def __len__(self) -> int:
        """How many votes are remembered."""
        return len(self._votes)

    @property
    def incarnation(self) -> bytes:
        """In which life this node is; another one means that it has lost its votes."""
        self.sit()
        return self._life

    def sit(self) -> None:
        """Take up the votes of an earlier life, or begin a new one."""
        if not self._life:
            self._load()

    def vote(self, place: Place) -> Vote | None:
        """How this node has voted about the tuple of ``place``, if it has."""
        return self._votes.get(place) if self.incarnation else None

    def unsettled(self) -> list[Posted]:
        """The tuples whose take was accepted here a while ago, and of which it has not heard since how that ended.

        Each is named again after ``UNSETTLED`` seconds, until ``settle`` is called.
        """
        now = self._clock.seconds()
        late = [place for place, since in self._unsettled.items() if since + UNSETTLED <= now]
        found = []
        for place in late:
            record = self._store.slot(place.slot)
            said = posting(record) if record is not None else None
            if isinstance(said, Posted) and said.place == place:
                self._unsettled[place] = now
                found.append(said)
            else:
                self.settle(place)  # taken out, or kept by others, who will see to it
        return found

    def settle(self, place: Place) -> None:
        """Take note that the decree on ``place`` has come to its end."""
        self._unsettled.pop(place, None)

    # -- what claimants ask -----------------------------------------------------------------------------------------

    def answer_enrol(self, peer: Contact) -> bytes:
        """ENROL: agree to be a member of councils, in this incarnation."""
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
        """CLAIM: promise the ballot for each of ``places`` under ``key`` and lease it, or say why not."""
        wanted, ballot = self._question(key, places, incarnation, counter, taker)
        if not 0.0 < lease <= MAX_LEASE:
            raise Refused(f"a lease lasts more than 0 and at most {MAX_LEASE:.0f} seconds")
        now = self._clock.seconds()
        return self._answer(wanted, [self._claimed(place, ballot, float(lease), now) for place in wanted])

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
        """CONFIRM: accept ``value`` as the taker of each of ``places`` under the ballot, or say why not."""
        wanted, ballot = self._question(key, places, incarnation, counter, taker)
        if not is_name(value):
            raise Refused("decree.confirm takes the name of a taker")
        now = self._clock.seconds()
        # A vote that is not here may have been forgotten: an empty one refuses, and is not kept.
        replies = [self._votes.get(place, Vote()).confirm(ballot, value, now) for place in wanted]
        for place in wanted:
            if place in self._votes and self._votes[place].state is State.CONFIRMED:
                self._unsettled.setdefault(place, now)
        return self._answer(wanted, replies)

    def answer_release(
        self, peer: Contact, key: bytes, places: list[object], incarnation: bytes, counter: int, taker: bytes
    ) -> Answers:
        """RELEASE: end the lease of the ballot on each of ``places``."""
        wanted, ballot = self._question(key, places, incarnation, counter, taker)
        now = self._clock.seconds()
        return [self._votes.get(place, Vote()).release(ballot, now).packed() for place in wanted]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _question(
        self, key: bytes, places: list[object], incarnation: bytes, counter: int, taker: bytes
    ) -> tuple[list[Place], Ballot]:
        """What every question names: tuples, and the ballot that it is asked under; raises ``Refused``."""
        if incarnation != self.incarnation:
            raise Refused("this member has lost its votes since it was called to that council")
        if len(key) != KEY_BYTES or not 0 < len(places) <= MAX_PLACES:
            raise Refused(f"a question names a key and 1 to {MAX_PLACES} places")
        wanted = [place for place in (place_unpacked(key, fields) for fields in places) if place is not None]
        if len(wanted) < len(places) or len(set(wanted)) < len(wanted):
            raise Refused("a place is an owner, a name and a mark, and a question names each place once")
        if not (is_counter(counter) and is_name(taker)):
            raise Refused("a ballot is a positive number and the name of a taker")
        return wanted, Ballot(counter, taker)

    def _claimed(self, place: Place, ballot: Ballot, lease: float, now: float) -> Reply:
        vote = self._votes.get(place)
        if vote is None:
            if ballot.counter <= self._floor or self._is_over(place):
                # Whatever was promised here and forgotten is not above the floor.
                return Reply(Kind.OUTBID, max(self._floor, ballot.counter))
            if len(self._votes) >= MAX_VOTES:
                self._make_room(now)
            vote = self._votes[place] = Vote()
            self._buckets.setdefault(_bucket(place), {})[place] = None
        return vote.claim(ballot, lease, now)

    def _is_over(self, place: Place) -> bool:
        """Whether the publisher has taken this tuple out, or put another one in its slot."""
        record = self._store.slot(place.slot)
        if record is None:
            return False
        said = posting(record)
        return not isinstance(said, Posted) or said.place != place

    def _make_room(self, now: float) -> None:
        """Forget old votes that can harm nobody: leases that have ended, and tuples that are no more."""
        spent: list[Place] = []
        for place in list(self._votes)[:LOOKED_AT]:
            vote = self._votes[place]
            if (vote.state is not State.CONFIRMED and vote.until <= now) or self._is_over(place):
                spent.append(place)
            else:  # it comes to the end of the queue
                self._votes[place] = self._votes.pop(place)
        if not spent:
            raise Refused(f"this member has {MAX_VOTES} votes to remember and takes no more; try another tuple")
        promised = [vote.promised.counter for p in spent if (vote := self._votes[p]).promised is not None]
        self._floor = max([self._floor, *promised])
        self._store.note(_FLOOR, self._floor.to_bytes(8, "big"))
        for place in spent:
            del self._votes[place]
            del self._buckets[_bucket(place)][place]
            self._unsettled.pop(place, None)
        self._note(spent)

    def _answer(self, places: list[Place], replies: list[Reply]) -> Answers:
        self._note(places)
        packed: list[object] = [reply.packed() for reply in replies]
        return packed if self.written is None else self.written().addCallback(lambda _: packed)

    def _note(self, places: list[Place]) -> None:
        for number in sorted({_bucket(place) for place in places}):
            votes = {place: self._votes[place] for place in self._buckets.get(number, ())}
            self._store.note(_bucket_name(number), packed_votes(votes))

    def _load(self) -> None:
        life = self._store.noted(_INCARNATION) or b""
        votes: dict[Place, Vote] | None = {} if len(life) == INCARNATION_BYTES else None
        for number in range(_BUCKETS):
            noted = self._store.noted(_bucket_name(number))
            if noted and votes is not None:
                read = votes_of(noted)
                votes = None if read is None else votes | read
        if votes is None:
            self._begin()
            return
        self._life = life
        self._floor = int.from_bytes(self._store.noted(_FLOOR) or b"")
        now = self._clock.seconds()
        for place, vote in votes.items():
            # Moments of an earlier life mean nothing: what was leased is leased for as long again.
            vote.until = now + vote.lease
            self._votes[place] = vote
            self._buckets.setdefault(_bucket(place), {})[place] = None
            if vote.state is State.CONFIRMED:
                self._unsettled[place] = now

    def _begin(self) -> None:
        """Begin a new life without votes."""
        self._life = self._rng.randbytes(INCARNATION_BYTES)
        for number in range(_BUCKETS):
            if self._store.noted(_bucket_name(number)):
                self._store.note(_bucket_name(number), packed_votes({}))
        self._store.note(_INCARNATION, self._life)


def packed_votes(votes: dict[Place, Vote]) -> bytes:
    """Votes as they stand in a note of the store."""
    rows: list[list[Any]] = []
    for place, vote in votes.items():
        if vote.promised is not None:
            accepted = [*vote.accepted, vote.value] if vote.accepted is not None else None
            rows.append([place.key, place.packed(), *vote.promised, vote.lease, accepted])
    return bytes(msgpack.packb(rows))


def votes_of(noted: bytes) -> dict[Place, Vote] | None:
    """The votes in one note of the store, or None where it is rotten."""
    try:
        rows = msgpack.unpackb(noted, strict_map_key=True, max_ext_len=0)
    except Exception:  # foreign code, and bytes that may have rotted
        return None
    votes = {}
    for row in rows if isinstance(rows, list) else [None]:
        if not isinstance(row, list) or len(row) != 6 or not isinstance(row[0], bytes) or len(row[0]) != KEY_BYTES:
            return None
        key, fields, counter, taker, lease, accepted = row
        place = place_unpacked(key, fields)
        if place is None or not (is_counter(counter) and is_name(taker)):
            return None
        if type(lease) is not float or not 0.0 <= lease <= MAX_LEASE:
            return None
        vote = votes[place] = Vote(Ballot(counter, taker), lease)
        if accepted is not None:
            if not isinstance(accepted, list) or len(accepted) != 3:
                return None
            bid, bidder, value = accepted
            if not (is_counter(bid) and is_name(bidder) and is_name(value)):
                return None
            vote.accepted, vote.value = Ballot(bid, bidder), value
    return votes


def _bucket(place: Place) -> int:
    return hashlib.blake2s(place.mark + place.owner, digest_size=1).digest()[0]


def _bucket_name(number: int) -> str:
    return f"decree/{number:02x}"
