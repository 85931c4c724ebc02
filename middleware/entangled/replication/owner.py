"""Owner: what a node does for the records that it owns.

It numbers and signs them, stores them where they belong until as many replicas have them as the write concern wants,
goes on until all have them, keeps leases alive, and mends what replicas have lost.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Literal

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background, paced, until
from middleware.entangled.contact import Contact
from middleware.entangled.data.store import Store
from middleware.entangled.errors import OWNER_FULL, Conflict, EntangledError, Full, NoAnswer, NotAcknowledged, Refused
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.overlay import Overlay
from middleware.entangled.record import TEAM_TTL, TOMBSTONE_TTL, Lifetime, Record, Slot
from middleware.entangled.replication.replica import Replica, pages_of
from middleware.entangled.replication.shipper import Shipper
from middleware.entangled.replication.store_reply import STORED, UNSYNCED, Outcome, StoreReply, decode_reply
from middleware.entangled.replication.watch import digest_of
from middleware.entangled.wire.door import ROLE, meaning
from middleware.entangled.wire.endpoint import Endpoint

Concern = Literal["one", "majority", "all"]
"""How many replicas must have a record before its writer is told so."""
RETRY = 10.0
"""Seconds between tries to bring a record to replicas that missed it."""
REPUBLISH = 3600.0
"""Seconds between two words of an owner about a team record: 24 for each life (Kademlia, section 2.5).  Within as many
every replica gives on what no other one gave on."""
BEATS_PER_LEASE = 3
SLACK = 1e-6
"""Seconds by which a sign of life may be early: sums of times are not exact."""
STEPS = 3
UNSURE_FOR = (0.1, 0.2, 0.4, 0.8)
"""Seconds after which a replica that is not sure yet, and whose word would count, is asked again."""
AT_ONCE = 32
"""Own records that are brought to their holders at the same time: more is sooner, and lets other questions wait."""
LONG = 2**16
"""Bytes of a value from which on its copies are sent in two waves."""
SPARE_S = 0.5
"""Seconds after which the second wave is not held back any longer, whatever became of the first."""
OWNERS_FAULT = (ROLE, OWNER_FULL)
"""Codes of refusals that are due to the owner of the record, and no fault of the replica."""
SEQUENCES = "sequences"
BLOCK = 1024
"""Sequence numbers that are noted in the store at once, so that not every write has to note one."""


class Stored(int):
    """How many replicas have a record; ``sequence`` is its number in its slot."""

    sequence: int

    @classmethod
    def of(cls, replicas: int, sequence: int) -> Stored:
        """That many replicas have the record of that number."""
        stored = cls(replicas)
        stored.sequence = sequence
        return stored


class Owner:
    """The own records of one node; ``lease`` is in seconds."""

    def __init__(
        self,
        identity: Identity,
        lease: float,
        store: Store,
        replica: Replica,
        overlay: Overlay,
        endpoint: Endpoint,
        clock: IReactorTime,
        chores: Background,
    ) -> None:
        self._identity = identity
        self._lease = lease
        self._store = store
        self._replica = replica
        self._overlay = overlay
        self._endpoint = endpoint
        self._clock = clock
        self._chores = chores
        self._shipper = Shipper(overlay, chores)
        self._own: dict[Slot, Record] = {}
        self._owing: dict[Slot, None] = {}
        self._said_at: dict[Slot, float] = {}
        self._leases: dict[Slot, float] = {}
        self._due_at: dict[Slot, float] = {}
        self._kept_by: dict[Slot, list[Contact]] = {}
        self._period = lease / BEATS_PER_LEASE
        self._bringing: set[bytes] = set()
        self._republishing = False
        self._next_beat: Callable[[], None] | None = None
        self._rested_at = -1.0
        self._first = self._last = self._noted = 0
        endpoint.expose("missing", self._answer_missing, changes=True)

    def start(self) -> None:
        """Take up the team records of an earlier life, and keep all own records alive from now on."""
        for record in self._store.owned(self._identity.public):
            if record.lifetime == "team" and not record.is_tombstone:
                self._own[record.slot] = record
        self._next_beat = self._chores.later(self._period, self._go_on)
        self._chores.every(RETRY, self._republish)

    def set_lease(self, lease: float) -> None:
        """Have own leases run for so many seconds from now on; they are told at once."""
        self._lease = lease
        self._due_at.clear()
        if self._next_beat is not None:
            self._next_beat()
            self._go_on()
        elif self._rested_at >= 0:
            self._rested_at = self._clock.seconds()

    def release(self, slot: Slot) -> None:
        """Say nothing more of the lease in ``slot``: it ends by itself, and leaves no tombstone."""
        record = self._own.get(slot)
        if record is not None and record.lifetime == "leased":
            self._let_go(slot)
            self._replica.answer_let_go(self._overlay.me(), [digest_of([record])])

    def review(self) -> None:
        """Look no more after what the role of this node does not allow any more."""
        if self._replica.certificates.door.authority(self._identity.public).is_final:
            for slot in [slot for slot in self._own if not self._replica.may_store(slot)]:
                self._let_go(slot)

    def owns(self, slot: Slot) -> bool:
        """Whether this node looks after what is in ``slot``."""
        return slot in self._own

    def next(
        self,
        key: bytes,
        name: str,
        value: bytes | None,
        lifetime: Lifetime,
        expect: int | None = None,
        read: Record | None = None,
        lease: float | None = None,
    ) -> Record:
        """The signed record that follows what the own slot (key, name) holds; from now on it is kept alive.

        A ``lease`` of its own, in seconds, is at least as long as the node's.  Raises ``Conflict`` where the slot does
        not hold the sequence ``expect``; ``read`` is what others hold there.
        """
        slot = Slot(key, self._identity.public, name)
        held = (self._own.get(slot), self._store.slot(slot), read)
        known = max((record.sequence for record in held if record is not None), default=0)
        if expect is not None and known != expect:
            raise Conflict(expect, known)
        self._leases.pop(slot, None)
        if lease is not None and lease > self._lease:
            self._leases[slot] = lease
        ttl = TOMBSTONE_TTL if value is None else self._lease_of(slot) if lifetime == "leased" else TEAM_TTL
        sequence = self._next_sequence(known)
        return self._take(Record(key, name, slot.owner, sequence, lifetime, ttl, value))

    async def put(self, record: Record, concern: Concern = "majority") -> Stored:
        """Store ``record`` where it belongs, at as many replicas as ``concern`` wants.

        A record of an earlier life of this node, which is still out there, is stepped over.  Raises ``NotAcknowledged``
        where too few replicas answer; the record is kept and brought to them when they are back.
        """
        for _ in range(STEPS):
            held, newest = await self.store_everywhere(record, concern)
            if not newest:
                return Stored.of(held, record.sequence)
            current = self._own.get(record.slot, record)
            if current.sequence <= newest:
                current = self._take(replace(current, sequence=self._next_sequence(newest)))
            # Where a newer value was put meanwhile, it is that one which is to hold.
            record = current
        raise NoAnswer(f"others hold a higher number in this slot, after {STEPS} steps")

    async def store_everywhere(self, record: Record, concern: Concern = "majority") -> tuple[int, int]:
        """Store at every holder: how many took it, and the highest sequence that stood against it (0: none).

        Raises ``NotAcknowledged`` where too few took it and nothing stood against it, ``Refused`` where that is because
        its owner's role may not write it, or the owner has as much as one owner may have.
        """
        if concern != "one":
            await self._overlay.met()
        targets = await self._overlay.holders(record.key)
        voters = self._overlay.voters(record.key, targets)
        needed = {"one": 1, "majority": voters.majority, "all": voters.size}[concern]

        def is_vote(node_id: bytes, reply: StoreReply) -> bool:
            return concern == "one" or (node_id in voters.ids and reply.outcome is not Outcome.UNSYNCED)

        left = self.left(record)
        replies: dict[bytes, StoreReply] = {}
        forbidden: list[Refused] = []
        counted = [c for c in targets if concern == "one" or c.node_id in voters.ids]
        spare = self._spare(record, targets, counted, needed)
        released: Deferred[None] = Deferred()

        def release() -> None:
            if not released.called:
                released.callback(None)

        async def store(contact: Contact) -> None:
            if contact.node_id in spare:
                await released
            try:
                reply = await self._store_latest(contact, record, left)
            except EntangledError as error:
                release()
                if isinstance(error, Refused) and error.code in OWNERS_FAULT:
                    forbidden.append(error)
                raise
            for pause in UNSURE_FOR if concern != "one" and contact.node_id in voters.ids else ():
                if reply.outcome is not Outcome.UNSYNCED:
                    break
                release()
                await self._chores.sleep(pause)
                reply = await self._store_latest(contact, record, left)
            replies[contact.node_id] = reply
            votes = voters.count_known(each for each, reply in replies.items() if reply.outcome is Outcome.STORED)
            if len(replies) == len(targets) and votes >= voters.majority:
                self._settled(record)

        work = until(
            lambda _: sum(1 for node_id, reply in replies.items() if is_vote(node_id, reply)) >= needed,
            [store(c) for c in sorted(targets, key=lambda c: c.node_id != self._identity.node_id)],
        )
        in_time = self._chores.later(SPARE_S, release) if spare else release
        await work
        in_time()
        release()
        answers = dict(replies)
        newest = max([0, *(reply.sequence for reply in answers.values())])
        held = sum(1 for reply in answers.values() if reply.is_stored)
        votes = sum(1 for node_id, reply in answers.items() if reply.is_stored and is_vote(node_id, reply))
        if votes < needed and not newest:
            if forbidden:
                if forbidden[0].code == ROLE:
                    self._let_go(record.slot)  # to say it again would change nothing
                raise forbidden[0]
            raise NotAcknowledged(votes, needed)
        return held, newest

    async def store_at(self, contact: Contact, record: Record, left: float | None = None) -> StoreReply:
        """Store at one replica: STORED, UNSYNCED or SUPERSEDED.  Raises ``Refused``.

        ``left`` are the seconds that it is to be kept, where it is not this node's own.
        """
        if contact.node_id == self._identity.node_id:
            return self._replica.store(record, left)
        reply = decode_reply(await self._shipper.store(contact, record, left), record)
        outcome = None if reply is None else reply.outcome
        if reply is not None and (reply.is_stored or outcome is Outcome.SUPERSEDED):
            return reply
        if outcome is Outcome.FORBIDDEN:
            raise Refused(f"{contact.address} does not take {record.name!r} from its owner: {meaning(ROLE)}", ROLE)
        if outcome is Outcome.NO_ROOM:
            text = f"{contact.address} holds all that it may of the owner of {record.name!r}; remove some records"
            raise Full(text, OWNER_FULL)
        raise Refused(f"{contact.address} does not take the record")

    def left(self, record: Record) -> float | None:
        """Seconds that ``record`` is to be kept by whom it is given on to; None for an own one: a whole ttl."""
        return None if record.owner == self._identity.public else self._replica.left(record)

    def welcome(self, contact: Contact) -> None:
        """Give a newcomer the own leases that it is now among the closest to; other records find it by themselves."""
        lacking = [r for r in self._leased() if self._overlay.belongs(r.key, contact)]
        if lacking:
            self._chores.fork(self._bring(contact, lacking))

    def lost_here(self, record: Record) -> bool:
        """Hold ``record`` on where it is one of our own: a late timer must not end our own lease.  Whether it was."""
        own = self._own.get(record.slot)
        if own is None:
            return False
        with suppress(Refused):  # no room here; the others may have some
            self._replica.keep(own)
        return True

    # -- inside -----------------------------------------------------------------------------------------------------

    async def _store_latest(self, contact: Contact, record: Record, left: float | None) -> StoreReply:
        """Store as ``store_at``; if a later record of this very life supersedes ``record``, store that one.

        The reply about the later one is valid for ``record`` too: the replica may be one whose word does not count.
        """
        reply = await self.store_at(contact, record, left)
        is_own = record.owner == self._identity.public and reply.outcome is Outcome.SUPERSEDED
        if not (is_own and self._first <= reply.sequence <= self._last):
            return reply
        later = self._own.get(record.slot)
        if later is None:
            return STORED  # it was a tombstone, and every replica has it
        reply = await self.store_at(contact, later)
        return UNSYNCED if reply.outcome is Outcome.SUPERSEDED else reply

    def _spare(self, record: Record, targets: list[Contact], counted: list[Contact], needed: int) -> frozenset[bytes]:
        """Of a long record, those that get it only when enough others have it: all at once would share the way."""
        if len(record.value or b"") < LONG or len(counted) < needed:
            return frozenset()
        likely = self._overlay.quickest(c for c in counted if c.node_id != self._identity.node_id)
        has_own = len(likely) < len(counted)
        at_first = {c.node_id for c in likely[: needed - has_own]} | {self._identity.node_id}
        return frozenset(c.node_id for c in targets if c.node_id not in at_first)

    def _next_sequence(self, above: int) -> int:
        """A number that no earlier record of this node has, not even one that only a lost replica knows."""
        if not self._noted:
            try:
                self._last = int(self._store.noted(SEQUENCES) or 0)
            except ValueError:  # a rotten file may hold anything
                self._last = 0
            self._last = max(self._last, above)
            self._first = self._last + 1
        self._last = max(self._last, above) + 1
        if self._last > self._noted:
            self._noted = self._last + BLOCK
            self._store.note(SEQUENCES, b"%d" % self._noted)
        return self._last

    def _take(self, record: Record) -> Record:
        record = record.signed(self._identity)
        self._own[record.slot] = record
        self._owing[record.slot] = None
        if record.lifetime == "leased":
            self._hasten(self._lease_of(record.slot) / BEATS_PER_LEASE)
        return record

    def _let_go(self, slot: Slot) -> None:
        for memory in (self._own, self._owing, self._said_at, self._leases, self._due_at, self._kept_by):
            memory.pop(slot, None)

    def _settled(self, record: Record) -> None:
        """All who should have ``record`` have it."""
        if self._own.get(record.slot) != record:
            return
        self._owing.pop(record.slot, None)
        self._said_at[record.slot] = self._clock.seconds()
        if record.is_tombstone:
            self._let_go(record.slot)

    def _leased(self) -> list[Record]:
        return [r for r in self._own.values() if r.lifetime == "leased"]

    def _lease_of(self, slot: Slot) -> float:
        return max(self._lease, self._leases.get(slot, 0.0))

    def _go_on(self) -> None:
        """Give the signs of life that are due, and come back as soon as the shortest lease wants the next."""
        leases = [self._lease_of(record.slot) for record in self._leased()]
        self._period = min(leases, default=self._lease) / BEATS_PER_LEASE
        self._next_beat = self._chores.later(self._period, self._go_on)
        if not self._beat():
            self._next_beat()
            self._next_beat, self._rested_at = None, self._clock.seconds()

    def _hasten(self, pause: float) -> None:
        """See that the next sign of life comes within ``pause``, where any are given at all."""
        if self._next_beat is None and self._rested_at >= 0:
            self._beat_again()
        elif self._next_beat is not None and pause < self._period:
            self._next_beat()
            self._next_beat = self._chores.later(pause, self._go_on)

    def _beat_again(self) -> None:
        """Go on where it was left off when nothing was leased: at a multiple of the beat."""
        now, at = self._clock.seconds(), self._rested_at
        beat = self._lease / BEATS_PER_LEASE
        at += beat * math.floor((now - at) / beat)
        while at <= now:
            at += beat
        self._next_beat = self._chores.later(at - now, self._go_on)

    def _beat(self) -> bool:
        """Say to the replicas of own leases that are due that this node lives, and what they should hold.

        Who holds longer leases beside a shorter one is told the shorter one.  Returns whether there are any.
        """
        now = self._clock.seconds()
        due: set[bytes] = set()
        there: dict[bytes, tuple[Contact, list[Record]]] = {}
        for record in self._leased():
            slot = record.slot
            if self._due_at.get(slot, now) <= now + SLACK:
                self._due_at[slot] = now + self._lease_of(slot) / BEATS_PER_LEASE
                self._kept_by[slot] = self._overlay.keepers(record.key)
                due.update(contact.node_id for contact in self._kept_by[slot])
            for contact in self._kept_by[slot]:
                there.setdefault(contact.node_id, (contact, []))[1].append(record)
        held = self._store.extend(self._identity.public, now + BEATS_PER_LEASE * self._period)
        for contact, records in there.values():
            if contact.node_id in due:
                lease = min(self._lease_of(record.slot) for record in records)
                self._endpoint.tell(contact, "alive", lease, digest_of(records))
        return held > 0 or bool(self._leased())

    def _answer_missing(self, peer: Contact, marks: list[object]) -> None:
        """Store at ``peer`` what it lacks of our leases, and tell it what it holds in vain."""
        there = [r for r in self._leased() if any(c.node_id == peer.node_id for c in self._overlay.keepers(r.key))]
        lawful = [digest_of([r]) for r in there]
        self._chores.fork(self._bring(peer, [r for r, mark in zip(there, lawful, strict=True) if mark not in marks]))
        strange = [mark for mark in marks if mark not in lawful]
        if strange:
            self._endpoint.tell(peer, "let_go", strange)

    def _republish(self) -> None:
        old = self._clock.seconds() - REPUBLISH
        due = [r for slot, r in self._own.items() if slot in self._owing or self._said_at.get(slot, old) <= old]
        if due and not self._republishing:
            self._chores.fork(self._say_again(due))

    async def _say_again(self, due: list[Record]) -> None:
        """Bring ``due`` to their holders; what was succeeded meanwhile is left out."""
        self._republishing = True
        try:
            await paced(AT_ONCE, (self.store_everywhere(r) for r in due if self._own.get(r.slot) is r))
        finally:
            self._republishing = False

    async def _bring(self, contact: Contact, records: list[Record]) -> None:
        """Store own records at ``contact``, page by page; one such work at a time for each contact."""
        if contact.node_id in self._bringing:
            return
        self._bringing.add(contact.node_id)
        try:
            for page in pages_of(records):
                with suppress(Refused):  # it has no room for one of them; the next page may have smaller ones
                    await self._overlay.ask(contact, "store", [r.packed() for r in page], changes=True)
        finally:
            self._bringing.discard(contact.node_id)
