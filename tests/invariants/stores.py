"""The workload of stores, with full and corrupt disks; it checks invariants S-a to S-c after power failures."""

from __future__ import annotations

import random
from typing import Any

from twisted.python.failure import Failure

from middleware.entangled.errors import EntangledError, Unwritable
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, hash_key
from sim.team.schedule import Schedule
from sim.team.sqlite_files import CheckedStore, SqliteTeam
from sim.team.workload import Workload
from tests.invariants.records import KEYS

PROBE = hash_key("probe of a full disk")
FULL = "database or disk is full"
EARLY = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""The times in seconds at which a node with a corrupt store is read."""
RECOVERY = 2.0
"""The time in seconds within which a node must write again after space has become available (S-c)."""


class Stores(Workload):
    """Fills the disk of one node after the other for some time, and corrupts one store."""

    def __init__(self, schedule: Schedule) -> None:
        assert isinstance(schedule.team, SqliteTeam)
        self._schedule = schedule
        self._fleet = schedule.team
        self._rng = random.Random(f"stores/{schedule.seed}")
        self._found: list[str] = []
        self._full: tuple[int, CheckedStore] | None = None
        self._number = 0
        schedule.team.watch_lives(self._born, lambda place, node: None)
        voters = min(schedule.n, 8)
        deaths = sum(len(fault.places) for fault in schedule.faults if fault.kind == "die")
        # A corrupt store removes a replica; the invariants hold only if a majority of the replicas remains.
        if deaths + 1 <= voters // 2:
            killed = [place for fault in schedule.faults if fault.kind.startswith("kill") for place in fault.places]
            if killed:
                schedule.team.planned_corruption[self._rng.choice(killed)] = self._rng.choice(["row", "file"])

    def step(self) -> None:
        """Fill a disk, probe a full disk, or free space."""
        if self._full is None:
            alive = self._schedule.alive()
            if alive and self._rng.random() < 0.1:
                place = self._rng.choice(alive)
                self._full = (place, self._fleet.get_store(place))
                self._full[1].writer.fault = FULL
                # This fault may last longer than other kinds of faults, but not longer than the repair interval.
                self._fleet.clock.callLater(self._rng.choice([1.0, 4.0, 8.0]), self._make_room)
            return
        place, store = self._full
        if store.write_error and not store.writer.is_closed:
            self._probe(place, store)

    def make_final_requests(self) -> None:
        """Check that all data has been written by now."""
        for place in self._schedule.alive():
            store = self._fleet.get_store(place)
            if store.write_error:
                self._say("S-c", f"node {place} has not resumed writing: {store.write_error}")
            written = store.wait_for_write()
            written.addErrback(self._unwritten, place)

    def find_violations(self) -> list[str]:
        """Compare the data in memory with the files; return all violations."""
        for line in self._fleet.lost:
            self._say("S-a", line)
        for line in self._fleet.undetected:
            self._say("S-b", line)
        for place in self._schedule.alive():
            store = self._fleet.get_store(place)
            while len(store.writer._pending) and not store.write_error:
                store.writer.commit_pending()
            for line in self._fleet.compare_content(place):
                self._say("S-a", line)
        return self._found

    def _unwritten(self, failure: Failure, place: int) -> None:
        self._say("S-c", f"node {place} cannot write: {failure.value}")

    # -- a corrupt store --------------------------------------------------------------------------------------------

    def _born(self, place: int, node: EntangledNode) -> None:
        if self._fleet.corrupted and self._fleet.corrupted[-1] == place:
            for moment in EARLY:
                self._fleet.clock.callLater(moment, self._read_early, place, node)

    def _read_early(self, place: int, node: EntangledNode) -> None:
        """Read at a node with a corrupt store, which must not deny records that a majority stores."""
        if place not in self._schedule.alive() or self._schedule.node(place) is not node:
            return
        for key in KEYS:
            if self._is_held(key):
                node.get(key, "fast").addCallbacks(self._read, _weather, (place, key))

    def _read(self, records: list[Record], place: int, key: bytes) -> None:
        if not records and self._is_held(key):
            self._say("S-b", f"node {place}, whose store is corrupt, finds no record under {key.hex()[:6]}")

    def _is_held(self, key: bytes) -> bool:
        holders = [place for place in self._schedule.alive() if self._fleet.get_store(place).get(key)]
        return 2 * len(holders) > min(self._schedule.n, 8) + 1

    # -- a full disk ------------------------------------------------------------------------------------------------

    def _make_room(self) -> None:
        if self._full is not None:
            place, store = self._full
            store.writer.fault = ""
            self._full = None
            self._fleet.clock.callLater(RECOVERY, self._recovered, place, store)

    def _recovered(self, place: int, store: CheckedStore) -> None:
        if store.write_error and not store.writer.is_closed and not store.writer.fault:
            self._say("S-c", f"node {place} does not write {RECOVERY:.0f} s after space was freed: {store.write_error}")

    def _probe(self, place: int, store: CheckedStore) -> None:
        """Write twice to the node with the full disk: once locally, once from another node."""
        self._number += 1
        node = self._schedule.node(place)
        record = self._record(node)
        try:
            store.put(record, 1e9)
        except Unwritable:
            pass
        else:
            self._say("S-c", f"node {place} accepts a record while its disk is full")
        if not node._running:
            self._say("S-c", f"node {place} left because its disk is full")
        others = [other for other in self._schedule.alive() if other != place]
        if others:
            requester = self._schedule.node(self._rng.choice(others))
            asked = requester.endpoint.ask(
                node.contact, "store", [self._record(requester).pack()], [60.0], changes=True
            )
            asked.addCallbacks(self._taken, self._refused, (place, store), {}, (place,))

    def _taken(self, answer: Any, place: int, store: CheckedStore) -> None:
        if store.writer.fault and answer == [0]:
            self._say("S-c", f"node {place} acknowledges a record while its disk is full")

    def _refused(self, failure: Failure, place: int) -> None:
        failure.trap(EntangledError)
        if "internal" in str(failure.value):
            self._say("S-c", f"node {place} does not report why it rejects the record: {failure.value}")

    def _record(self, node: EntangledNode) -> Record:
        name = f"probe {self._number}"
        return Record(PROBE, name, node.identity.public, 1, "team", 60.0, b"1").sign(node.identity)

    def _say(self, invariant: str, text: str) -> None:
        line = f"{invariant}: {text}"
        if line not in self._found:
            self._found.append(line)


def _weather(failure: Failure) -> None:
    failure.trap(EntangledError)
