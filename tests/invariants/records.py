"""The workload of records: puts, removals and reads of all concerns, and D1 to D7 over what came of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from twisted.internet.defer import Deferred
from twisted.python.failure import Failure

from middleware.entangled.errors import EntangledError, Unavailable
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.distance import closest
from middleware.entangled.kademlia.overlay import K
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, Slot, hashed_key
from tests.invariants.schedule import Schedule

KEYS = [hashed_key(f"key {number}") for number in range(4)]
NAMES = ("a", "b")


@dataclass
class _Slot:
    """What is known of a slot: the last write that was begun, and the highest that was acknowledged or read.

    ``values`` are the numbers of writes with a value; the others were removals.
    """

    begun: int = 0
    floor: int = 0
    seen: dict[EntangledNode, int] = field(default_factory=dict)
    values: dict[int, bytes] = field(default_factory=dict)
    started: dict[int, float] = field(default_factory=dict)


class Records:
    """Clients of every node write their own slots under a few keys and read all of them."""

    def __init__(self, schedule: Schedule) -> None:
        self._schedule = schedule
        self._rng = schedule.rng
        self._slots: dict[Slot, _Slot] = {}
        self._found: list[str] = []
        self._held: dict[tuple[int, int, Slot], tuple[int, bytes]] = {}
        self._old: list[Record] = []
        self._is_over = False
        self._finds: list[tuple[int, bytes, list[Any]]] = []
        if schedule.liar is not None:
            self._let_lie(schedule.node(schedule.liar))

    def step(self) -> None:
        """A few operations at random nodes, and a look at every store and table."""
        alive = self._schedule.alive()
        for _ in range(self._rng.randrange(3)):
            if alive:
                act = self._rng.choice([self._put, self._put, self._remove, self._read, self._read, self._meddle])
                act(self._schedule.node(self._rng.choice(alive)))
        self._look()

    def settled(self) -> None:
        """Everybody reads everything, and looks up a few ids."""
        self._is_over = True
        self._look()
        alive = self._schedule.alive()
        for place in alive:
            for key in KEYS:
                self._get(self._schedule.node(place), key, "majority")
                self._get(self._schedule.node(place), key, "fast")
            for target in KEYS[:2]:
                found: list[Any] = []
                self._schedule.node(place).find_node(target).addBoth(found.append)
                self._finds.append((place, target, found))

    def verdict(self) -> list[str]:
        """What was found, and the tables as they are now."""
        alive = self._schedule.alive()
        contacts = {place: self._schedule.node(place).contact for place in alive}
        for place in alive:
            others = sorted(contact.node_id for other, contact in contacts.items() if other != place)
            known = [contact.node_id for contact in self._schedule.node(place).overlay.roster.live()]
            if known != others:
                self._say("D7", f"node {place} knows {len(known)} live members, there are {len(others)} others")
        for place, target, found in self._finds:
            truth = closest([c for other, c in contacts.items() if other != place], target, K)
            if not found or found[0] != truth:
                self._say("D6", f"node {place} does not find the closest to {target.hex()[:6]}: {found}")
        return self._found

    # -- what clients do --------------------------------------------------------------------------------------------

    def _put(self, node: EntangledNode) -> None:
        key, name = self._rng.choice(KEYS), self._rng.choice(NAMES)
        concern = self._rng.choice(["majority", "majority", "majority", "all"])
        self._write(node, key, name, concern)

    def _remove(self, node: EntangledNode) -> None:
        mine = [slot for slot in self._slots if slot.owner == node.identity.public]
        if mine:
            slot = self._rng.choice(mine)
            self._write(node, slot.key, slot.name, "majority", is_removal=True)

    def _write(self, node: EntangledNode, key: bytes, name: str, concern: Any, is_removal: bool = False) -> None:
        slot = self._slots.setdefault(Slot(key, node.identity.public, name), _Slot())
        slot.begun += 1
        number = slot.begun
        slot.started[number] = self._schedule.fleet.clock.seconds()
        if is_removal:
            stored = node.remove(key, name, concern)
        else:
            slot.values[number] = b"%d" % number
            stored = node.put(key, name, slot.values[number], "team", concern)
        stored.addCallbacks(lambda _: self._raise(slot, number), _weather)

    def _raise(self, slot: _Slot, number: int) -> None:
        slot.floor = max(slot.floor, number)

    def _read(self, node: EntangledNode) -> None:
        self._get(node, self._rng.choice(KEYS), self._rng.choice(["majority", "majority", "fast"]))

    def _get(self, node: EntangledNode, key: bytes, concern: Any) -> None:
        floors = {
            place: max(slot.floor, slot.seen.get(node, 0)) for place, slot in self._slots.items() if place.key == key
        }
        started = self._schedule.fleet.clock.seconds()
        work: Deferred[list[Record]] = node.get(key, concern)
        work.addCallbacks(
            lambda records: self._check(node, key, concern, records, floors, started),
            lambda failure: self._failed(failure, key, concern),
        )

    def _failed(self, failure: Failure, key: bytes, concern: str) -> None:
        failure.trap(EntangledError)
        if self._is_over:
            what = "is not answered" if failure.check(Unavailable) else f"fails: {failure.value}"
            self._say("D7", f"a {concern} read of {key.hex()[:6]} {what} after everything healed")

    def _check(
        self,
        node: EntangledNode,
        key: bytes,
        concern: str,
        records: list[Record],
        floors: dict[Slot, int],
        started: float,
    ) -> None:
        """Hold what a read gave against what was acknowledged before it began."""
        there = {record.slot: int(record.value or b"0") for record in records}
        for place, number in there.items():
            if place not in self._slots or number not in self._slots[place].values:
                self._say("D4", f"a read shows {place.name}={number}, which its owner never wrote")
        is_sure = concern == "majority" or self._is_over
        for place, floor in floors.items():
            slot, shown = self._slots[place], there.get(place)
            where = f"{concern} read of {place.key.hex()[:6]} {place.owner.hex()[:4]}/{place.name} at {started:.1f}"
            removals = [n for n in range(max(floor, 1), slot.begun + 1) if n not in slot.values]
            if shown is None:
                # Absent is right only where a removal may be the newest, or nothing was acknowledged yet.
                if floor and not removals and (is_sure or not there):
                    self._say("D1", f"{where}: {floor} was acknowledged or read, nothing is found")
            elif is_sure and shown < floor:
                removed = floor not in slot.values
                self._say("D3" if removed else "D2", f"{where}: shows {shown} after {floor}")
            elif concern == "majority":
                slot.seen[node] = max(slot.seen.get(node, 0), shown)
        self._old += [record for record in records if len(self._old) < 50]

    def _meddle(self, node: EntangledNode) -> None:
        """A member stores what it must not: an old record of another, and one that it made up."""
        if not self._old:
            return
        old = self._rng.choice(self._old)
        made_up = Record(old.key, old.name, old.owner, old.sequence + 99, "team", 60.0, b"77777", old.signature)
        for contact in node.overlay.responsible(old.key):
            if contact.node_id != node.identity.node_id:
                asked = node.endpoint.ask(contact, "store", [old.packed()], [old.ttl], changes=True)
                asked.addErrback(_weather)
                if contact.public != old.owner and node.identity.public != old.owner:
                    forged = node.endpoint.ask(contact, "store", [made_up.packed()], [60.0], changes=True)
                    forged.addErrback(_weather)

    def _let_lie(self, node: EntangledNode) -> None:
        """A member that names contacts that are not there."""
        ghosts = [Identity(bytes([n]) * 32) for n in range(200, 204)]
        named = [[ghost.public, "10.9.9.9", 9000 + n] for n, ghost in enumerate(ghosts)]
        node.endpoint.expose("find_node", lambda peer, target: named)
        node.endpoint.expose("members", lambda peer, after: [] if after else named)

    # -- what everybody can see -------------------------------------------------------------------------------------

    def _look(self) -> None:
        fleet = self._schedule.fleet
        places = {fleet.identity(place).public: place for place in range(self._schedule.n)}
        for place in self._schedule.alive():
            node = self._schedule.node(place)
            for contact in node.overlay.contacts():
                other = places.get(contact.public)
                if other is None or other == place or contact.address != fleet.address(other):
                    self._say("D5", f"node {place} has {contact.address} in its table")
            for record in fleet.stores[place].records():
                at = (place, fleet.memory(place), record.slot)
                mark = (record.sequence, record.signature)
                if record.lifetime == "team" and mark < self._held.get(at, mark):
                    self._say("D4", f"node {place} went back to {mark[0]} in {record.name}")
                if mark != self._held.get(at) and record.lifetime == "team" and not record.is_genuine():
                    self._say("D4", f"node {place} holds a forged record in {record.name}")
                self._held[at] = mark

    def _say(self, invariant: str, text: str) -> None:
        line = f"{invariant}: {text}"
        if line not in self._found:
            self._found.append(line)


def _weather(failure: Failure) -> None:
    failure.trap(EntangledError)
