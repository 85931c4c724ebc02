"""EntangledNode: the verbs of the library, wired over overlay, replica, watches and the sealed endpoint.

It keeps its own records alive where they belong, and what it watches up to date.
"""

from __future__ import annotations

import random
from collections.abc import Coroutine, Sequence
from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background, first
from middleware.entangled.errors import Alone, EntangledError, NoAnswer, NotRunning, TooLarge
from middleware.entangled.identity import Identity, node_id
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.network.network import Address, Network
from middleware.entangled.overlay import Overlay
from middleware.entangled.record import MAX_NAME, MAX_VALUE, Lifetime, Record, Slot, unpacked
from middleware.entangled.replica import Replica
from middleware.entangled.store import Store
from middleware.entangled.watch import Changed, Watch, digest_of
from middleware.entangled.wire.endpoint import Endpoint

TEAM_TTL = 86400.0
RENEW = 2.0
REPUBLISH = 10.0
BEATS_PER_LEASE = 3


class EntangledNode:
    """One peer.

    ``lease`` is how long, in seconds, what this node owns on lease outlives its last sign of life; more means fewer false losses,
    less means quicker notice.  ``rng`` and ``clock`` are the only sources of chance and time.
    """

    def __init__(
        self,
        identity: Identity,
        team_key: bytes,
        network: Network,
        store: Store,
        clock: IReactorTime,
        rng: random.Random,
        lease: float = 1.0,
    ) -> None:
        self.identity = identity
        self.store = store
        self.lease = lease
        self._network = network
        self._clock = clock
        self._chores = Background(clock)
        self.endpoint = Endpoint(identity, team_key, network, clock, rng)
        self.overlay = Overlay(lambda: self.contact, self.endpoint, clock, rng, self._chores)
        self.overlay.on_newcomer = self._welcome
        self.overlay.on_lost = self._lost
        self.replica = Replica(store, self.endpoint, clock, self._chores)
        self.replica.on_record = self._held_here
        self.replica.on_gone = self._gone_here
        self.replica.on_goodbye = self.overlay.left
        self._own: dict[Slot, Record] = {}
        self._watches: list[Watch] = []
        self._running = False
        self.endpoint.expose("push", self._answer_push, changes=True)
        self.endpoint.expose("missing", self._answer_missing)

    # -- life -------------------------------------------------------------------------------------------------------

    @property
    def contact(self) -> Contact:
        """This node as others know it."""
        return Contact(self.identity.public, self._network.address)

    def start(self) -> None:
        """Open the port and begin to keep leases, watches and contacts fresh; raises ``PortInUse``."""
        self.endpoint.start()
        self._running = True
        self.overlay.start()
        self.replica.start()
        self._chores.every(self.lease / BEATS_PER_LEASE, self._beat)
        self._chores.every(RENEW, self._renew_all)
        self._chores.every(REPUBLISH, self._republish)

    def join(self, known: Sequence[Address]) -> Deferred[None]:
        """Enter the network through ``known`` nodes (thesis, Algorithm 4.1), trying again with back-off until one answers.

        Fires when the node has looked up its own id; at once where ``known`` is empty (the first node of a network).
        """
        return _run(self.overlay.join(known))

    def stop(self) -> None:
        """Say goodbye, so that what is leased here leaves at once, and close the port."""
        if self._running:
            for contact in self.overlay.table.contacts():
                self.endpoint.tell(contact, "goodbye")
        self.vanish()

    def vanish(self) -> None:
        """Leave without a word, as a node does whose power or radio fails."""
        if self._running:
            self._running = False
            self._watches.clear()
            self._chores.stop()
            self.endpoint.stop()

    # -- verbs ------------------------------------------------------------------------------------------------------

    def put(self, key: bytes, name: str, value: bytes, lifetime: Lifetime = "team") -> Deferred[int]:
        """Store ``value`` in the slot (key, this node, name); fires with the number of replicas once a majority has it.

        Raises ``TooLarge`` at once for a value over ``MAX_VALUE`` or a name over ``MAX_NAME``; fails with ``NoAnswer``
        where no majority could be reached.
        """
        if len(value) > MAX_VALUE:
            raise TooLarge(f"value of {len(value)} bytes; a record carries at most {MAX_VALUE}")
        if len(name) > MAX_NAME:
            raise TooLarge(f"name of {len(name)} characters; a record's name has at most {MAX_NAME}")
        return _run(self._put(self._next(key, name, value, lifetime)))

    def remove(self, key: bytes, name: str) -> Deferred[int]:
        """Empty a slot of this node: a tombstone takes the place of its record."""
        return _run(self._put(self._next(key, name, None, "team")))

    def get(self, key: bytes) -> Deferred[list[Record]]:
        """What the network holds under ``key``: the merged answers of the nodes closest to it."""
        return _run(self._get(key))

    def watch(self, key: bytes, changed: Changed) -> Watch:
        """Call ``changed`` with all records of ``key`` whenever they are different, until ``stop()`` of what is returned."""
        self._check_running()
        watch = Watch(key, changed, self)
        self._watches.append(watch)
        watch.view.replace(self.identity.node_id, self.store.get(key, tombstones=True))
        watch.settle()
        self._chores.fork(self._renew(watch))
        return watch

    def unwatch(self, watch: Watch) -> None:
        """Forget ``watch``; replicas forget it by themselves when it is not renewed."""
        if watch in self._watches:
            self._watches.remove(watch)

    def find_node(self, node_id: bytes) -> Deferred[list[Contact]]:
        """The k live nodes closest to ``node_id``, by an iterative lookup (Kademlia, section 2.3)."""
        return _run(self.overlay.lookup(node_id))

    # -- newcomers --------------------------------------------------------------------------------------------------

    def _welcome(self, contact: Contact) -> None:
        """Give a newcomer what it is now among the closest to, and hear what it holds of watched keys."""
        handed = [r for r in self._own.values() if self.overlay.belongs(r.key, contact)]
        for record in self.store.records():
            if record.lifetime == "team" and record.slot not in self._own and self.overlay.belongs(record.key, contact):
                others = [c for c in self.overlay.responsible(record.key) if c.node_id != contact.node_id]
                if not others or others[0].node_id == self.identity.node_id:
                    handed.append(record)
        for record in handed:
            self._chores.fork(self._store_at(contact, record))
        for watch in self._watches:
            if self.overlay.belongs(watch.key, contact):
                self._chores.fork(self._renew_at(watch, contact))

    def _lost(self, contact: Contact) -> None:
        """What a lost contact said of others does not count any more."""
        for watch in list(self._watches):
            watch.view.forget(contact.node_id)
            watch.settle()

    # -- storing ----------------------------------------------------------------------------------------------------

    def _next(self, key: bytes, name: str, value: bytes | None, lifetime: Lifetime) -> Record:
        self._check_running()
        slot = Slot(key, self.identity.public, name)
        known = [r.sequence for r in (self._own.get(slot), self.store.slot(slot)) if r is not None]
        ttl = self.lease if lifetime == "leased" else TEAM_TTL
        record = Record(key, name, slot.owner, max(known, default=0) + 1, lifetime, ttl, value)
        record = record.signed(self.identity)
        self._own[slot] = record
        if lifetime == "team" and value is None:
            del self._own[slot]
        return record

    async def _put(self, record: Record) -> int:
        held, newest = await self._store_everywhere(record)
        if newest > record.sequence:
            # A record of an earlier life of this node is still out there: step over it.
            record = replace(record, sequence=newest + 1).signed(self.identity)
            if record.slot in self._own:
                self._own[record.slot] = record
            held, newest = await self._store_everywhere(record)
        return held

    async def _store_everywhere(self, record: Record) -> tuple[int, int]:
        targets = await self.overlay.holders(record.key)
        here = self.replica.keep(record) if self.contact in targets else 0
        others = [c for c in targets if c.node_id != self.identity.node_id]
        needed = len(targets) // 2 + 1
        answers = await first(needed - (self.contact in targets), [self._store_at(c, record) for c in others])
        held = sum(1 for a in answers if a == 0) + (self.contact in targets and here == 0)
        newest = max([here, *answers])
        if held < needed and newest <= 0:
            raise NoAnswer(f"{held} of {len(targets)} replicas took the record, {needed} are needed")
        return held, newest

    async def _store_at(self, contact: Contact, record: Record) -> int:
        answer = await self.overlay.ask(contact, "store", [record.packed()], changes=True)
        return int(answer[0]) if isinstance(answer, list) and answer and type(answer[0]) is int else -1

    # -- finding ----------------------------------------------------------------------------------------------------

    async def _get(self, key: bytes) -> list[Record]:
        targets = await self.overlay.holders(key)
        if targets == [self.contact] and not len(self.overlay.table):
            return self.store.get(key)
        watch = Watch(key, lambda records: None, self)
        if self.contact in targets:
            watch.view.replace(self.identity.node_id, self.store.get(key, tombstones=True))
        others = [c for c in targets if c.node_id != self.identity.node_id]
        answered = await first(len(others), [self._read_at(watch, c) for c in others])
        if others and not answered:
            raise Alone("no node that holds this key answers")
        return watch.view.merged()

    async def _read_at(self, watch: Watch, contact: Contact) -> None:
        watch.view.replace(contact.node_id, await self._pages(contact, watch.key, None))

    async def _pages(self, contact: Contact, key: bytes, first: object) -> list[Record]:
        records: list[Record] = []
        page = first if first is not None else await self.overlay.ask(contact, "find_value", key, None)
        for _ in range(1000):
            if not (isinstance(page, list) and len(page) == 2 and isinstance(page[0], list)):
                break
            for fields in page[0]:
                record = unpacked(fields)
                if record is not None and record.key == key and (
                    record.owner == contact.public or self.store.slot(record.slot) == record or record.is_genuine()
                ):
                    records.append(record)
            if page[1] is None:
                break
            page = await self.overlay.ask(contact, "find_value", key, page[1])
        return records

    # -- watching ---------------------------------------------------------------------------------------------------

    def _renew_all(self) -> None:
        for watch in list(self._watches):
            self._chores.fork(self._renew(watch))

    async def _renew(self, watch: Watch) -> None:
        targets = await self.overlay.holders(watch.key)
        for contact in targets:
            if contact.node_id != self.identity.node_id:
                self._chores.fork(self._renew_at(watch, contact))

    async def _renew_at(self, watch: Watch, contact: Contact) -> None:
        try:
            digest = watch.view.digest(contact.node_id)
            first = await self.overlay.ask(contact, "watch", watch.key, digest, changes=True)
            if first is not None:
                watch.view.replace(contact.node_id, await self._pages(contact, watch.key, first))
                watch.settle()
        except EntangledError:
            watch.view.forget(contact.node_id)
            watch.settle()

    def _answer_push(self, peer: Contact, key: bytes, packed: list[object], gone: list[object]) -> None:
        for watch in [w for w in self._watches if w.key == key]:
            for fields in packed:
                record = unpacked(fields)
                if record is not None and record.key == key and (record.owner == peer.public or record.is_genuine()):
                    watch.view.add(peer.node_id, record)
            for place in gone:
                if isinstance(place, list) and len(place) == 2:
                    watch.view.remove(peer.node_id, Slot(key, place[0], place[1]))
            watch.settle()

    def _held_here(self, record: Record) -> None:
        for watch in [w for w in self._watches if w.key == record.key]:
            watch.view.add(self.identity.node_id, record)
            watch.settle()

    def _gone_here(self, slot: Slot) -> None:
        own = self._own.get(slot)
        if own is not None:
            # A late timer must not make a node believe that it lost its own lease.
            self.replica.keep(own)
            return
        owner = node_id(slot.owner)
        for watch in list(self._watches):
            if watch.key == slot.key:
                watch.view.remove(self.identity.node_id, slot)
            # Whoever let its lease run out no longer speaks for others either.
            watch.view.forget(owner)
            watch.settle()

    # -- staying alive ----------------------------------------------------------------------------------------------

    def _beat(self) -> None:
        leased = [r for r in self._own.values() if r.lifetime == "leased"]
        if not leased:
            return
        self.store.extend(self.identity.public, self._clock.seconds() + self.lease)
        for contact in self.overlay.table.contacts():
            there = [r for r in leased if self.overlay.belongs(r.key, contact)]
            if there:
                self.endpoint.tell(contact, "alive", self.lease, digest_of(there))

    def _answer_missing(self, peer: Contact) -> None:
        for record in list(self._own.values()):
            if record.lifetime == "leased" and self.overlay.belongs(record.key, peer):
                self._chores.fork(self._store_at(peer, record))

    def _republish(self) -> None:
        for record in list(self._own.values()):
            if record.lifetime == "team":
                self._chores.fork(self._store_everywhere(record))

    def _check_running(self) -> None:
        if not self._running:
            raise NotRunning("start the node first")


def _run(work: Coroutine[Any, Any, Any]) -> Deferred[Any]:
    return Deferred.fromCoroutine(work)
