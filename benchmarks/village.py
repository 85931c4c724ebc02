"""Village: nodes whose records are kept by a town clerk, so that thousands of tuples can be taken in a minute.

Seats, spaces and the wire between them are those that ship; only records are not replicated: one list holds them all,
and everybody hears of changes a little later.  What is shown here is shown of the councils, not of the replicas.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

from twisted.internet import defer
from twisted.internet.defer import Deferred

from benchmarks.takers import TEAM, Trial
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.kademlia.distance import closest
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, Slot
from middleware.entangled.space.seat import Seat
from middleware.entangled.wire.endpoint import Endpoint

FOREVER = 1e9


class House:
    """One node of a village: what ``TupleSpace`` needs of an ``EntangledNode``."""

    def __init__(self, village: VillageTrial, place: int, identity: Identity, rng: random.Random) -> None:
        self.identity = identity
        self.store = village.stores[place]
        self.watches: list[HouseWatch] = []
        self._village = village
        self._rng = rng
        self._network = village.board.network(*village.address(place))
        self.contact = Contact(identity.public, self._network.address)
        self.endpoint = Endpoint(identity, TEAM, self._network, village.clock, rng)
        self.overlay = SimpleNamespace(table={})
        self.seat = Seat(self.endpoint, self.store, village.clock, rng)

    def start(self) -> None:
        """Open the port."""
        self.endpoint.start()

    def join(self, known: object) -> None:
        """Everybody knows everybody here."""

    def vanish(self) -> None:
        """Leave without a word."""
        self.endpoint.stop()
        self.watches.clear()

    def find_node(self, target: bytes) -> Deferred[list[Contact]]:
        """The others who live, the closest first."""
        others = [house.contact for house in self._village.houses() if house is not self]
        return defer.succeed(closest(others, target, 8))

    def put(self, key: bytes, name: str, value: bytes | None) -> Deferred[int]:
        """Store a record a little later, unless this node dies before."""
        sequence = self._village.sequence(Slot(key, self.identity.public, name))
        record = Record(key, name, self.identity.public, sequence, "team", 60.0, value).signed(self.identity)
        done: Deferred[int] = Deferred()

        def arrive() -> None:
            if self.endpoint.is_running:
                self._village.stored(record)
                done.callback(5)

        self._village.clock.callLater(self._rng.uniform(0.002, 0.05), arrive)
        return done

    def remove(self, key: bytes, name: str) -> Deferred[int]:
        """Empty a slot."""
        return self.put(key, name, None)

    def get(self, key: bytes) -> Deferred[list[Record]]:
        """What stands under ``key``, heard a little later."""
        done: Deferred[list[Record]] = Deferred()
        self._village.clock.callLater(self._rng.uniform(0.002, 0.05), done.callback, self._village.under(key))
        return done

    def watch(self, key: bytes, changed: Callable[[list[Record]], None]) -> HouseWatch:
        """Tell ``changed`` of every change."""
        watch = HouseWatch(self, key, changed, self._village.under(key))
        self.watches.append(watch)
        return watch

    def refresh(self, watch: HouseWatch) -> None:
        """Nothing: no push is ever lost here."""


class HouseWatch:
    """A watch of one house."""

    def __init__(
        self, house: House, key: bytes, changed: Callable[[list[Record]], None], records: list[Record]
    ) -> None:
        self.key = key
        self.records = records
        self._house = house
        self._changed = changed

    def tell(self, records: list[Record]) -> None:
        """Tell of a change, if anybody still listens."""
        if self in self._house.watches:
            self.records = records
            self._changed(records)

    def stop(self) -> None:
        """End it."""
        if self in self._house.watches:
            self._house.watches.remove(self)


class VillageTrial(Trial):
    """A trial in a village."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        self._records: dict[Slot, Record] = {}
        self._sequences: dict[Slot, int] = {}
        super().__init__(*arguments, **keywords)

    def houses(self) -> list[House]:
        """Those who live."""
        return [cast(House, node) for node in self.nodes if node is not None]

    def node(self, place: int, identity: Identity, rng: random.Random) -> EntangledNode:
        """A house for the node of this place."""
        return cast(EntangledNode, House(self, place, identity, rng))

    def sequence(self, slot: Slot) -> int:
        """The next number in a slot."""
        self._sequences[slot] = self._sequences.get(slot, 0) + 1
        return self._sequences[slot]

    def under(self, key: bytes) -> list[Record]:
        """The records of ``key``."""
        return [record for record in self._records.values() if record.key == key and not record.is_tombstone]

    def stored(self, record: Record) -> None:
        """Keep a record, and tell everybody who watches, each a little later."""
        if not record.beats(self._records.get(record.slot)):
            return
        self._records[record.slot] = record
        self.witness.stored(record)
        for store in self.stores:
            store.put(record, FOREVER)
        for house in self.houses():
            for watch in [watch for watch in house.watches if watch.key == record.key]:
                self.clock.callLater(self.rng.uniform(0.001, 0.03), self._tell, watch)

    def _tell(self, watch: HouseWatch) -> None:
        watch.tell(self.under(watch.key))
