"""Trials of a tuple space with one list of records instead of replicas, so that thousands of tuples take a minute.

Acceptors, tuple spaces and the endpoints between them are production code; only records are not replicated: one list
holds all of them, and watchers are notified of changes with a delay.  These trials test councils, not replicas.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any, cast

from twisted.internet import defer
from twisted.internet.defer import Deferred

from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.distance import closest
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, Slot
from middleware.entangled.space.seat import Seat
from middleware.entangled.wire.endpoint import Endpoint
from sim.team.takers.trial import Trial
from sim.team.world import TEAM

FOREVER = 1e9


class LightNode:
    """One node of a trial, with the interface that a tuple space requires (``space.peer.Peer``)."""

    def __init__(self, trial: LightTrial, place: int, identity: Identity, rng: random.Random) -> None:
        self.identity = identity
        self.store = trial.store(place)
        self.watches: list[LightWatch] = []
        self._trial = trial
        self._rng = rng
        self._network = trial.network(place)
        self.contact = Contact(identity.public, self._network.address)
        self.endpoint = Endpoint(identity, TEAM, self._network, trial.clock, rng)
        self.seat = Seat(self.endpoint, self.store, trial.clock, rng)

    def start(self) -> None:
        """Open the port."""
        self.endpoint.start()

    def join(self, known: object) -> None:
        """Do nothing: all nodes know each other."""

    def vanish(self) -> None:
        """Leave without notice."""
        self.endpoint.stop()
        self.watches.clear()

    def find_node(self, target: bytes) -> Deferred[list[Contact]]:
        """Fire with the other living nodes, closest first."""
        others = [node.contact for node in self._trial.living_nodes() if node is not self]
        return defer.succeed(closest(others, target, 8))

    def newest(self, contact: Contact) -> Contact:
        """Return ``contact``: addresses do not change here."""
        return contact

    def put(self, key: bytes, name: str, value: bytes | None) -> Deferred[int]:
        """Store a record after a delay, unless this node dies before."""
        sequence = self._trial.sequence(Slot(key, self.identity.public, name))
        record = Record(key, name, self.identity.public, sequence, "team", 60.0, value).signed(self.identity)
        done: Deferred[int] = Deferred()

        def arrive() -> None:
            if self.endpoint.is_running:
                self._trial.stored(record)
                done.callback(5)

        self._trial.clock.callLater(self._rng.uniform(0.002, 0.05), arrive)
        return done

    def remove(self, key: bytes, name: str) -> Deferred[int]:
        """Write a tombstone."""
        return self.put(key, name, None)

    def get(self, key: bytes) -> Deferred[list[Record]]:
        """Fire with the records under ``key`` after a delay."""
        done: Deferred[list[Record]] = Deferred()
        self._trial.clock.callLater(self._rng.uniform(0.002, 0.05), done.callback, self._trial.under(key))
        return done

    def watch(self, key: bytes, changed: Callable[[list[Record]], None]) -> LightWatch:
        """Call ``changed`` at every change."""
        watch = LightWatch(self, key, changed, self._trial.under(key))
        self.watches.append(watch)
        return watch

    def refresh(self, watch: LightWatch) -> None:
        """Do nothing: pushes are never lost here."""


class LightWatch:
    """A watch of one node."""

    def __init__(
        self, node: LightNode, key: bytes, changed: Callable[[list[Record]], None], records: list[Record]
    ) -> None:
        self.key = key
        self.records = records
        self._node = node
        self._changed = changed

    def tell(self, records: list[Record]) -> None:
        """Notify the watcher, if the watch has not ended."""
        if self in self._node.watches:
            self.records = records
            self._changed(records)

    def stop(self) -> None:
        """End the watch."""
        if self in self._node.watches:
            self._node.watches.remove(self)


class LightTrial(Trial):
    """A trial with light nodes."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        self._records: dict[Slot, Record] = {}
        self._sequences: dict[Slot, int] = {}
        super().__init__(*arguments, **keywords)

    def living_nodes(self) -> list[LightNode]:
        """Return the living nodes."""
        return [self.living[place] for place in self.alive()]

    def node(self, place: int, identity: Identity, rng: random.Random) -> EntangledNode:
        """Return a light node for this place."""
        return cast(EntangledNode, LightNode(self, place, identity, rng))

    def sequence(self, slot: Slot) -> int:
        """Return the next sequence number of a slot."""
        self._sequences[slot] = self._sequences.get(slot, 0) + 1
        return self._sequences[slot]

    def under(self, key: bytes) -> list[Record]:
        """Return the records of ``key``."""
        return [record for record in self._records.values() if record.key == key and not record.is_tombstone]

    def stored(self, record: Record) -> None:
        """Store a record, and notify all watchers with random delays."""
        if not record.beats(self._records.get(record.slot)):
            return
        self._records[record.slot] = record
        self.witness.stored(record)
        for store in self.stores.values():
            store.put(record, FOREVER)
        for node in self.living_nodes():
            for watch in [watch for watch in node.watches if watch.key == record.key]:
                self.clock.callLater(self.dice.uniform(0.001, 0.03), self._tell, watch)

    def _tell(self, watch: LightWatch) -> None:
        watch.tell(self.under(watch.key))
