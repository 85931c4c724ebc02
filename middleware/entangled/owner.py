"""Owner: what a node does for the records that it owns.

It numbers and signs them, stores them where they belong with the consent of a majority, keeps leases alive, and mends
what replicas have lost.
"""

from __future__ import annotations

from collections.abc import Coroutine
from dataclasses import replace
from typing import Any

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background, first
from middleware.entangled.errors import NoAnswer, Refused
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.overlay import Overlay
from middleware.entangled.record import Lifetime, Record, Slot
from middleware.entangled.replica import Replica
from middleware.entangled.store import Store
from middleware.entangled.watch import digest_of
from middleware.entangled.wire.endpoint import Endpoint

TEAM_TTL = 86400.0
REPUBLISH = 10.0
BEATS_PER_LEASE = 3
TOMBSTONE_ROUNDS = 3
"""How often a tombstone is stored again, for replicas that missed it."""
STEPS = 3
MAX_SEQUENCE = 2**62


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
        self._own: dict[Slot, Record] = {}
        self._rounds: dict[Slot, int] = {}
        endpoint.expose("missing", self._answer_missing, changes=True)

    def start(self) -> None:
        """Take up the team records of an earlier life, and keep all own records alive from now on."""
        for record in self._store.owned(self._identity.public):
            if record.lifetime == "team" and not record.is_tombstone:
                self._own[record.slot] = record
        self._chores.every(self._lease / BEATS_PER_LEASE, self._beat)
        self._chores.every(REPUBLISH, self._republish)

    def owns(self, slot: Slot) -> bool:
        """Whether this node looks after what is in ``slot``."""
        return slot in self._own

    def next(self, key: bytes, name: str, value: bytes | None, lifetime: Lifetime) -> Record:
        """The signed record that follows what the own slot (key, name) holds; from now on it is kept alive."""
        slot = Slot(key, self._identity.public, name)
        known = [r.sequence for r in (self._own.get(slot), self._store.slot(slot)) if r is not None]
        ttl = self._lease if lifetime == "leased" else TEAM_TTL
        return self._take(Record(key, name, slot.owner, max(known, default=0) + 1, lifetime, ttl, value))

    async def put(self, record: Record) -> int:
        """Store ``record`` where it belongs; the number of replicas that have it, a majority at least.

        A record of an earlier life of this node, which is still out there, is stepped over.  Raises ``NoAnswer``.
        """
        for _ in range(STEPS):
            held, newest = await self.store_everywhere(record)
            if newest < record.sequence:
                return held
            current = self._own.get(record.slot, record)
            if current.sequence <= newest:
                current = self._take(replace(current, sequence=newest + 1))
            # Where a newer value was put meanwhile, it is that one which is to hold.
            record = current
        raise NoAnswer(f"others hold a higher number in this slot, after {STEPS} steps")

    async def store_everywhere(self, record: Record) -> tuple[int, int]:
        """Store at every holder: how many took it, and the highest sequence that stood against it (0: none).

        Raises ``NoAnswer`` where no majority took it and nothing stood against it.
        """
        targets = await self._overlay.holders(record.key)
        others = [c for c in targets if c.node_id != self._identity.node_id]
        here = self._kept_here(record) if len(others) < len(targets) else []
        needed = len(targets) // 2 + 1
        answers = here + await first(needed - len(here), [self.store_at(c, record) for c in others])
        held, newest = answers.count(0), max(answers, default=0)
        if held < needed and newest < record.sequence:
            raise NoAnswer(f"{held} of {len(targets)} replicas took the record, {needed} are needed")
        return held, newest

    async def store_at(self, contact: Contact, record: Record) -> int:
        """Store at one replica: 0, or the sequence that holds there against ``record``.  Raises ``Refused``."""
        answer = await self._overlay.ask(contact, "store", [record.packed()], changes=True)
        verdict = answer[0] if isinstance(answer, list) and len(answer) == 1 else None
        if type(verdict) is int and (verdict == 0 or record.sequence <= verdict < MAX_SEQUENCE):
            return verdict
        raise Refused(f"{contact.address} does not take the record")

    def welcome(self, contact: Contact) -> None:
        """Give a newcomer what it is now among the closest to."""
        self._spread([self.store_at(contact, r) for r in self._own.values() if self._overlay.belongs(r.key, contact)])

    def lost_here(self, record: Record) -> bool:
        """Hold ``record`` on where it is one of our own: a late timer must not end our own lease.  Whether it was."""
        own = self._own.get(record.slot)
        if own is not None:
            self._kept_here(own)
        return own is not None

    # -- inside -----------------------------------------------------------------------------------------------------

    def _take(self, record: Record) -> Record:
        record = record.signed(self._identity)
        self._own[record.slot] = record
        self._rounds.pop(record.slot, None)
        if record.is_tombstone:
            self._rounds[record.slot] = TOMBSTONE_ROUNDS
        return record

    def _kept_here(self, record: Record) -> list[int]:
        try:
            return [self._replica.keep(record)]
        except Refused:
            return []  # no room here; the others may have some

    def _leased(self) -> list[Record]:
        return [r for r in self._own.values() if r.lifetime == "leased"]

    def _beat(self) -> None:
        """Say to every replica of an own lease that this node lives, and what it should hold."""
        there: dict[bytes, tuple[Contact, list[Record]]] = {}
        for record in self._leased():
            for contact in self._overlay.keepers(record.key):
                there.setdefault(contact.node_id, (contact, []))[1].append(record)
        self._store.extend(self._identity.public, self._clock.seconds() + self._lease)
        for contact, records in there.values():
            self._endpoint.tell(contact, "alive", self._lease, digest_of(records))

    def _answer_missing(self, peer: Contact, marks: list[object]) -> None:
        """Store at ``peer`` what it lacks of our leases, and tell it what it holds in vain."""
        there = [r for r in self._leased() if any(c.node_id == peer.node_id for c in self._overlay.keepers(r.key))]
        lawful = [digest_of([r]) for r in there]
        self._spread([self.store_at(peer, r) for r, mark in zip(there, lawful, strict=True) if mark not in marks])
        strange = [mark for mark in marks if mark not in lawful]
        if strange:
            self._endpoint.tell(peer, "let_go", strange)

    def _republish(self) -> None:
        self._spread([self.store_everywhere(record) for record in self._own.values()])
        for slot in list(self._rounds):
            self._rounds[slot] -= 1
            if not self._rounds[slot]:
                del self._rounds[slot], self._own[slot]

    def _spread(self, work: list[Coroutine[Any, Any, Any]]) -> None:
        for coroutine in work:
            self._chores.fork(coroutine)
