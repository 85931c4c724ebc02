"""Writing and maintenance of a node's own records.

The owner numbers and signs its records and stores them at their replicas: first at as many as the consistency level
requires, then at the remaining replicas.  It also renews leases, and restores records that replicas have lost.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Literal

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background, gather_until, run_limited
from middleware.entangled.contact import Contact
from middleware.entangled.data.store import Store
from middleware.entangled.errors import OWNER_FULL, Conflict, EntangledError, Full, NoAnswer, NotAcknowledged, Refused
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.overlay import Overlay
from middleware.entangled.record import TEAM_TTL_S, TOMBSTONE_TTL_S, Lifetime, Record, Slot
from middleware.entangled.replication.batcher import RecordBatcher
from middleware.entangled.replication.replica import Replica, split_pages
from middleware.entangled.replication.store_reply import STORED, UNSYNCED, Outcome, StoreReply, decode_reply
from middleware.entangled.replication.watch import digest_of
from middleware.entangled.wire.admission_check import ROLE, explain
from middleware.entangled.wire.endpoint import Endpoint

ConsistencyLevel = Literal["one", "majority", "all"]
"""Consistency level: the number of replicas that must store a record before ``put`` succeeds."""
RETRY_INTERVAL_S = 10.0
"""Seconds between two attempts to store a record at replicas that have not received it."""
REPUBLISH_INTERVAL_S = 3600.0
"""Seconds between two publications of a team record by its owner: 24 per lifetime (Kademlia, section 2.5).  A replica
republishes a record that no other node has republished for this time."""
RENEWALS_PER_LEASE = 3
RENEWAL_TOLERANCE_S = 1e-6
"""A renewal may be this number of seconds early, so that rounding errors in sums of times do no harm."""
MAX_ATTEMPTS = 3
UNSYNCED_RETRIES_S = (0.1, 0.2, 0.4, 0.8)
"""The seconds before the first, second, ... repetition of a request to a voter that is not synced yet."""
MAX_PARALLEL = 32
"""The number of own records that are republished at the same time.  With a higher number, the republication ends
earlier, but delays other requests."""
MIN_TWO_WAVES_BYTES = 2**16
"""The size of a value in bytes from which its copies are sent in two waves."""
SECOND_WAVE_S = 0.5
"""Seconds after which the second wave is sent even if the first wave has not finished."""
OWNER_FAULT_CODES = (ROLE, OWNER_FULL)
"""The codes of rejections that are caused by the owner of the record, not by the replica."""
SEQUENCES_NOTE = "sequences"
SEQUENCE_BLOCK = 1024
"""The number of sequence numbers that one note in the store reserves, so that not every write needs a note."""


class Stored(int):
    """The number of replicas that have a record; ``sequence`` is the record's sequence number."""

    sequence: int

    @classmethod
    def make(cls, replicas: int, sequence: int) -> Stored:
        """Return ``replicas`` with the attribute ``sequence``."""
        stored = cls(replicas)
        stored.sequence = sequence
        return stored


class Owner:
    """The records owned by one node; ``lease`` is in seconds."""

    def __init__(
        self,
        identity: Identity,
        lease: float,
        store: Store,
        replica: Replica,
        overlay: Overlay,
        endpoint: Endpoint,
        clock: IReactorTime,
        background: Background,
    ) -> None:
        self._identity = identity
        self._lease = lease
        self._store = store
        self._replica = replica
        self._overlay = overlay
        self._endpoint = endpoint
        self._clock = clock
        self._background = background
        self._batcher = RecordBatcher(overlay, background)
        self._own: dict[Slot, Record] = {}
        self._incomplete: dict[Slot, None] = {}
        self._published_at: dict[Slot, float] = {}
        self._leases: dict[Slot, float] = {}
        self._due_at: dict[Slot, float] = {}
        self._replicas: dict[Slot, list[Contact]] = {}
        self._period = lease / RENEWALS_PER_LEASE
        self._transferring: set[bytes] = set()
        self._is_republishing = False
        self._cancel_renewal: Callable[[], None] | None = None
        self._paused_at = -1.0
        self._first_sequence = self._last_sequence = self._reserved_sequence = 0
        endpoint.expose("missing", self._answer_missing, changes=True)

    def start(self) -> None:
        """Load the team records of an earlier run, and start to renew all own records."""
        for record in self._store.find_owned(self._identity.public):
            if record.lifetime == "team" and not record.is_tombstone:
                self._own[record.slot] = record
        self._cancel_renewal = self._background.later(self._period, self._renew_due)
        self._background.every(RETRY_INTERVAL_S, self._republish)

    def set_lease(self, lease: float) -> None:
        """Set the duration of own leases to ``lease`` seconds and renew them immediately."""
        self._lease = lease
        self._due_at.clear()
        if self._cancel_renewal is not None:
            self._cancel_renewal()
            self._renew_due()
        elif self._paused_at >= 0:
            self._paused_at = self._clock.seconds()

    def release(self, slot: Slot) -> None:
        """Stop renewing the leased record in ``slot``, so that it expires without a tombstone."""
        record = self._own.get(slot)
        if record is not None and record.lifetime == "leased":
            self._forget(slot)
            self._replica.answer_let_go(self._overlay.own_contact(), [digest_of([record])])

    def recheck(self) -> None:
        """Drop the own records that this node's role no longer allows."""
        if self._replica.certificates.admission.find_authority(self._identity.public).is_final:
            for slot in [slot for slot in self._own if not self._replica.may_store(slot)]:
                self._forget(slot)

    def owns(self, slot: Slot) -> bool:
        """Return whether this node maintains the record in ``slot``."""
        return slot in self._own

    def make_record(
        self,
        key: bytes,
        name: str,
        value: bytes | None,
        lifetime: Lifetime,
        expect: int | None = None,
        read: Record | None = None,
        lease: float | None = None,
    ) -> Record:
        """Return the next signed record for the own slot (key, name), and maintain it from now on.

        A ``lease`` in seconds applies if it is longer than the node's.  Raises ``Conflict`` if the sequence number of
        the slot is not ``expect``; ``read`` is the record that other nodes store in the slot.
        """
        slot = Slot(key, self._identity.public, name)
        held = (self._own.get(slot), self._store.get_slot(slot), read)
        known = max((record.sequence for record in held if record is not None), default=0)
        if expect is not None and known != expect:
            raise Conflict(expect, known)
        self._leases.pop(slot, None)
        if lease is not None and lease > self._lease:
            self._leases[slot] = lease
        ttl = TOMBSTONE_TTL_S if value is None else self._lease_of(slot) if lifetime == "leased" else TEAM_TTL_S
        sequence = self._next_sequence(known)
        return self._sign(Record(key, name, slot.owner, sequence, lifetime, ttl, value))

    async def put(self, record: Record, concern: ConsistencyLevel = "majority") -> Stored:
        """Store ``record`` at its replicas, as many as ``concern`` requires.

        If the replicas store a record with a higher sequence number, which this node wrote before its restart, the new
        record gets a number above it.  Raises ``NotAcknowledged`` if too few replicas answer; the record is stored at
        the missing replicas when they return.
        """
        for _ in range(MAX_ATTEMPTS):
            held, newest = await self.store_everywhere(record, concern)
            if not newest:
                return Stored.make(held, record.sequence)
            current = self._own.get(record.slot, record)
            if current.sequence <= newest:
                current = self._sign(replace(current, sequence=self._next_sequence(newest)))
            # If the application has put a newer value during the attempt, store the newer value.
            record = current
        raise NoAnswer(
            f"replicas still have a higher sequence number after {MAX_ATTEMPTS} attempts; put the value again"
        )

    async def store_everywhere(self, record: Record, concern: ConsistencyLevel = "majority") -> tuple[int, int]:
        """Store ``record`` at all replicas.

        Returns the number of replicas that stored the record, and the highest sequence number of a conflicting record
        (0: no conflict).  Raises ``NotAcknowledged`` if too few replicas stored the record and there was no conflict.
        Raises ``Refused`` if the reason is the owner's role or its share of the store.
        """
        if concern != "one":
            await self._overlay.wait_for_members()
        targets = await self._overlay.lookup_replicas(record.key)
        voters = self._overlay.find_voters(record.key, targets)
        needed = {"one": 1, "majority": voters.majority, "all": voters.size}[concern]

        def is_vote(node_id: bytes, reply: StoreReply) -> bool:
            return concern == "one" or (node_id in voters.ids and reply.outcome is not Outcome.UNSYNCED)

        left = self.remaining_lifetime(record)
        replies: dict[bytes, StoreReply] = {}
        forbidden: list[Refused] = []
        counted = [c for c in targets if concern == "one" or c.node_id in voters.ids]
        second_wave = self._choose_second_wave(record, targets, counted, needed)
        released: Deferred[None] = Deferred()

        def release() -> None:
            if not released.called:
                released.callback(None)

        async def store(contact: Contact) -> None:
            if contact.node_id in second_wave:
                await released
            try:
                reply = await self._store_latest(contact, record, left)
            except EntangledError as error:
                release()
                if isinstance(error, Refused) and error.code in OWNER_FAULT_CODES:
                    forbidden.append(error)
                raise
            for pause in UNSYNCED_RETRIES_S if concern != "one" and contact.node_id in voters.ids else ():
                if reply.outcome is not Outcome.UNSYNCED:
                    break
                release()
                await self._background.sleep(pause)
                reply = await self._store_latest(contact, record, left)
            replies[contact.node_id] = reply
            votes = voters.count_known(each for each, reply in replies.items() if reply.outcome is Outcome.STORED)
            if len(replies) == len(targets) and votes >= voters.majority:
                self._mark_complete(record)

        work = gather_until(
            lambda _: sum(1 for node_id, reply in replies.items() if is_vote(node_id, reply)) >= needed,
            [store(c) for c in sorted(targets, key=lambda c: c.node_id != self._identity.node_id)],
        )
        in_time = self._background.later(SECOND_WAVE_S, release) if second_wave else release
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
                    self._forget(record.slot)  # a retry would be rejected again
                raise forbidden[0]
            raise NotAcknowledged(votes, needed)
        return held, newest

    async def store_at(self, contact: Contact, record: Record, left: float | None = None) -> StoreReply:
        """Store ``record`` at one replica; return STORED, UNSYNCED or SUPERSEDED; raise ``Refused``.

        ``left`` is the remaining lifetime in seconds of a record that this node does not own.
        """
        if contact.node_id == self._identity.node_id:
            return self._replica.store(record, left)
        reply = decode_reply(await self._batcher.store(contact, record, left), record)
        outcome = None if reply is None else reply.outcome
        if reply is not None and (reply.is_stored or outcome is Outcome.SUPERSEDED):
            return reply
        if outcome is Outcome.FORBIDDEN:
            raise Refused(f"{contact.address} rejects the record {record.name!r}: {explain(ROLE)}", ROLE)
        if outcome is Outcome.NO_ROOM:
            text = f"{contact.address} has no space for the owner of {record.name!r}; remove records of this owner"
            raise Full(text, OWNER_FULL)
        raise Refused(f"{contact.address} rejects the record")

    def remaining_lifetime(self, record: Record) -> float | None:
        """Return the seconds for which a receiver must store ``record``; None (its whole ttl) for an own record."""
        return None if record.owner == self._identity.public else self._replica.remaining_lifetime(record)

    def handle_new_contact(self, contact: Contact) -> None:
        """Store at a new node the own leased records for which it is a replica; it fetches team records by itself."""
        lacking = [r for r in self._list_leased() if self._overlay.is_replica(r.key, contact)]
        if lacking:
            self._background.fork(self._send(contact, lacking))

    def restore(self, record: Record) -> bool:
        """If this node owns ``record``, store it again, because a late timer let it expire; return whether it does."""
        own = self._own.get(record.slot)
        if own is None:
            return False
        with suppress(Refused):  # this node's store is full; other replicas may have space
            self._replica.store_locally(own)
        return True

    # -- inside -----------------------------------------------------------------------------------------------------

    async def _store_latest(self, contact: Contact, record: Record, left: float | None) -> StoreReply:
        """Store ``record`` as ``store_at`` does, or a later record that has replaced it since this node's start.

        The reply about the later record is also valid for ``record``, and indicates whether the replica is synced.
        """
        reply = await self.store_at(contact, record, left)
        is_own = record.owner == self._identity.public and reply.outcome is Outcome.SUPERSEDED
        if not (is_own and self._first_sequence <= reply.sequence <= self._last_sequence):
            return reply
        later = self._own.get(record.slot)
        if later is None:
            return STORED  # the later record is a tombstone that all replicas have
        reply = await self.store_at(contact, later)
        return UNSYNCED if reply.outcome is Outcome.SUPERSEDED else reply

    def _choose_second_wave(
        self, record: Record, targets: list[Contact], counted: list[Contact], needed: int
    ) -> frozenset[bytes]:
        """Return the replicas that get a long record in the second wave; simultaneous copies share the bandwidth."""
        if len(record.value or b"") < MIN_TWO_WAVES_BYTES or len(counted) < needed:
            return frozenset()
        likely = self._overlay.order_by_speed(c for c in counted if c.node_id != self._identity.node_id)
        has_own = len(likely) < len(counted)
        at_first = {c.node_id for c in likely[: needed - has_own]} | {self._identity.node_id}
        return frozenset(c.node_id for c in targets if c.node_id not in at_first)

    def _next_sequence(self, above: int) -> int:
        """Return a sequence number above all earlier sequence numbers of this node, in any slot or run."""
        if not self._reserved_sequence:
            try:
                self._last_sequence = int(self._store.get_note(SEQUENCES_NOTE) or 0)
            except ValueError:  # a corrupt file may contain anything
                self._last_sequence = 0
            self._last_sequence = max(self._last_sequence, above)
            self._first_sequence = self._last_sequence + 1
        self._last_sequence = max(self._last_sequence, above) + 1
        if self._last_sequence > self._reserved_sequence:
            self._reserved_sequence = self._last_sequence + SEQUENCE_BLOCK
            self._store.set_note(SEQUENCES_NOTE, b"%d" % self._reserved_sequence)
        return self._last_sequence

    def _sign(self, record: Record) -> Record:
        record = record.sign(self._identity)
        self._own[record.slot] = record
        self._incomplete[record.slot] = None
        if record.lifetime == "leased":
            self._renew_within(self._lease_of(record.slot) / RENEWALS_PER_LEASE)
        return record

    def _forget(self, slot: Slot) -> None:
        for memory in (self._own, self._incomplete, self._published_at, self._leases, self._due_at, self._replicas):
            memory.pop(slot, None)

    def _mark_complete(self, record: Record) -> None:
        """Note that all replicas have ``record``."""
        if self._own.get(record.slot) != record:
            return
        self._incomplete.pop(record.slot, None)
        self._published_at[record.slot] = self._clock.seconds()
        if record.is_tombstone:
            self._forget(record.slot)

    def _list_leased(self) -> list[Record]:
        return [r for r in self._own.values() if r.lifetime == "leased"]

    def _lease_of(self, slot: Slot) -> float:
        return max(self._lease, self._leases.get(slot, 0.0))

    def _renew_due(self) -> None:
        """Send the renewals that are due, and schedule the next renewals by the shortest lease."""
        leases = [self._lease_of(record.slot) for record in self._list_leased()]
        self._period = min(leases, default=self._lease) / RENEWALS_PER_LEASE
        self._cancel_renewal = self._background.later(self._period, self._renew_due)
        if not self._send_renewals():
            self._cancel_renewal()
            self._cancel_renewal, self._paused_at = None, self._clock.seconds()

    def _renew_within(self, pause: float) -> None:
        """Schedule the next renewal within ``pause`` seconds, if renewals have started."""
        if self._cancel_renewal is None and self._paused_at >= 0:
            self._resume_renewals()
        elif self._cancel_renewal is not None and pause < self._period:
            self._cancel_renewal()
            self._cancel_renewal = self._background.later(pause, self._renew_due)

    def _resume_renewals(self) -> None:
        """Resume renewals after a time without leases, at a multiple of the renewal period."""
        now, at = self._clock.seconds(), self._paused_at
        beat = self._lease / RENEWALS_PER_LEASE
        at += beat * math.floor((now - at) / beat)
        while at <= now:
            at += beat
        self._cancel_renewal = self._background.later(at - now, self._renew_due)

    def _send_renewals(self) -> bool:
        """Renew the own leases that are due: send each replica its lease and the digest of its records.

        If a replica has records with different lease durations, it gets the shortest duration.  Returns whether there
        are any leases.
        """
        now = self._clock.seconds()
        due: set[bytes] = set()
        there: dict[bytes, tuple[Contact, list[Record]]] = {}
        for record in self._list_leased():
            slot = record.slot
            if self._due_at.get(slot, now) <= now + RENEWAL_TOLERANCE_S:
                self._due_at[slot] = now + self._lease_of(slot) / RENEWALS_PER_LEASE
                self._replicas[slot] = self._overlay.find_possible_replicas(record.key)
                due.update(contact.node_id for contact in self._replicas[slot])
            for contact in self._replicas[slot]:
                there.setdefault(contact.node_id, (contact, []))[1].append(record)
        held = self._store.extend_leases(self._identity.public, now + RENEWALS_PER_LEASE * self._period)
        for contact, records in there.values():
            if contact.node_id in due:
                lease = min(self._lease_of(record.slot) for record in records)
                self._endpoint.notify(contact, "alive", lease, digest_of(records))
        return held > 0 or bool(self._list_leased())

    def _answer_missing(self, peer: Contact, marks: list[object]) -> None:
        """Answer MISSING: store at ``peer`` the own leased records that it lacks, and name the records to drop."""
        there = [
            r
            for r in self._list_leased()
            if any(c.node_id == peer.node_id for c in self._overlay.find_possible_replicas(r.key))
        ]
        expected = [digest_of([r]) for r in there]
        self._background.fork(
            self._send(peer, [r for r, mark in zip(there, expected, strict=True) if mark not in marks])
        )
        unexpected = [mark for mark in marks if mark not in expected]
        if unexpected:
            self._endpoint.notify(peer, "let_go", unexpected)

    def _republish(self) -> None:
        old = self._clock.seconds() - REPUBLISH_INTERVAL_S
        due = [
            r for slot, r in self._own.items() if slot in self._incomplete or self._published_at.get(slot, old) <= old
        ]
        if due and not self._is_republishing:
            self._background.fork(self._republish_all(due))

    async def _republish_all(self, due: list[Record]) -> None:
        """Republish the records ``due``, except records that have been replaced by then."""
        self._is_republishing = True
        try:
            await run_limited(MAX_PARALLEL, (self.store_everywhere(r) for r in due if self._own.get(r.slot) is r))
        finally:
            self._is_republishing = False

    async def _send(self, contact: Contact, records: list[Record]) -> None:
        """Store own records at ``contact``, page by page, unless such a transfer to ``contact`` is already running."""
        if contact.node_id in self._transferring:
            return
        self._transferring.add(contact.node_id)
        try:
            for page in split_pages(records):
                with suppress(Refused):  # there is no space for one record; the records of the next page may be smaller
                    await self._overlay.ask(contact, "store", [r.pack() for r in page], changes=True)
        finally:
            self._transferring.discard(contact.node_id)
