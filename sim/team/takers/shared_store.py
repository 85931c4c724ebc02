"""Run trials of a tuple space with one list of records instead of replicas, so that thousands of tuples take a minute.

Acceptors, tuple spaces and the endpoints between them are production code. Only records are not replicated: one list
contains all records, and watchers are notified of changes with a delay. These trials test councils, not replicas.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any, cast

from twisted.internet import defer
from twisted.internet.defer import Deferred

from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.distance import select_closest
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, Slot
from middleware.entangled.space.take_acceptor import TakeAcceptor
from middleware.entangled.wire.endpoint import Endpoint
from sim.team.simulation import TEAM_KEY
from sim.team.takers.trial import TakingTrial

FOREVER_S = 1e9


class SharedStoreNode:
    """One node of a trial, with the interface that a tuple space requires (``space.node_interface.NodeInterface``)."""

    def __init__(self, trial: SharedStoreTrial, place: int, identity: Identity, rng: random.Random) -> None:
        self.identity = identity
        self.store = trial.store(place)
        self.watches: list[SharedStoreWatch] = []
        self._trial = trial
        self._rng = rng
        self._network = trial.network(place)
        self.contact = Contact(identity.public, self._network.address)
        self.endpoint = Endpoint(identity, TEAM_KEY, self._network, trial.clock, rng)
        self.take_acceptor = TakeAcceptor(self.endpoint, self.store, trial.clock, rng)

    def start(self) -> None:
        """Open the port."""
        self.endpoint.start()

    def join(self, known: object) -> None:
        """Do nothing: all nodes know each other."""

    def stop_silently(self) -> None:
        """Stop without notifying other nodes."""
        self.endpoint.stop()
        self.watches.clear()

    def find_node(self, target: bytes) -> Deferred[list[Contact]]:
        """Fire with the other living nodes, closest first."""
        others = [node.contact for node in self._trial.living_nodes() if node is not self]
        return defer.succeed(select_closest(others, target, 8))

    def find_newest(self, contact: Contact) -> Contact:
        """Return ``contact``, because addresses do not change in these trials."""
        return contact

    def put(self, key: bytes, name: str, value: bytes | None) -> Deferred[int]:
        """Store a record after a delay, unless this node has died by then."""
        sequence = self._trial.next_sequence(Slot(key, self.identity.public, name))
        record = Record(key, name, self.identity.public, sequence, "team", 60.0, value).sign(self.identity)
        done: Deferred[int] = Deferred()

        def arrive() -> None:
            if self.endpoint.is_running:
                self._trial.store_record(record)
                done.callback(5)

        self._trial.clock.callLater(self._rng.uniform(0.002, 0.05), arrive)
        return done

    def remove(self, key: bytes, name: str) -> Deferred[int]:
        """Write a tombstone."""
        return self.put(key, name, None)

    def get(self, key: bytes) -> Deferred[list[Record]]:
        """Fire with the records under ``key`` after a delay."""
        done: Deferred[list[Record]] = Deferred()
        self._trial.clock.callLater(self._rng.uniform(0.002, 0.05), done.callback, self._trial.find_records(key))
        return done

    def watch(self, key: bytes, changed: Callable[[list[Record]], None]) -> SharedStoreWatch:
        """Call ``changed`` at every change."""
        watch = SharedStoreWatch(self, key, changed, self._trial.find_records(key))
        self.watches.append(watch)
        return watch

    def refresh(self, watch: SharedStoreWatch) -> None:
        """Do nothing, because pushes are never lost in these trials."""


class SharedStoreWatch:
    """A watch of one node."""

    def __init__(
        self, node: SharedStoreNode, key: bytes, changed: Callable[[list[Record]], None], records: list[Record]
    ) -> None:
        self.key = key
        self.records = records
        self._node = node
        self._changed = changed

    def notify(self, records: list[Record]) -> None:
        """Notify the watcher unless the watch has ended."""
        if self in self._node.watches:
            self.records = records
            self._changed(records)

    def stop(self) -> None:
        """End the watch."""
        if self in self._node.watches:
            self._node.watches.remove(self)


class SharedStoreTrial(TakingTrial):
    """A trial with light nodes."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        self._records: dict[Slot, Record] = {}
        self._sequences: dict[Slot, int] = {}
        super().__init__(*arguments, **keywords)

    def living_nodes(self) -> list[SharedStoreNode]:
        """Return the living nodes."""
        return [self.living[place] for place in self.alive()]

    def make_node(self, place: int, identity: Identity, rng: random.Random) -> EntangledNode:
        """Return a light node for this place."""
        return cast(EntangledNode, SharedStoreNode(self, place, identity, rng))

    def next_sequence(self, slot: Slot) -> int:
        """Return the next sequence number of a slot."""
        self._sequences[slot] = self._sequences.get(slot, 0) + 1
        return self._sequences[slot]

    def find_records(self, key: bytes) -> list[Record]:
        """Return the records of ``key``."""
        return [record for record in self._records.values() if record.key == key and not record.is_tombstone]

    def store_record(self, record: Record) -> None:
        """Store a record, and notify all watchers with random delays."""
        if not record.supersedes(self._records.get(record.slot)):
            return
        self._records[record.slot] = record
        self.recorder.record_tuple(record)
        for store in self.stores.values():
            store.put(record, FOREVER_S)
        for node in self.living_nodes():
            for watch in [watch for watch in node.watches if watch.key == record.key]:
                self.clock.callLater(self.trial_rng.uniform(0.001, 0.03), self._notify, watch)

    def _notify(self, watch: SharedStoreWatch) -> None:
        watch.notify(self.find_records(watch.key))
