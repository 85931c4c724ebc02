"""The workload of records: writes, removals and reads at all consistency levels.

It records the results and checks the invariants D1 to D7.
"""

from __future__ import annotations

from typing import Any

from twisted.python.failure import Failure

from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.overlay import K
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, hash_key
from sim.team.clients import REMOVE, Clients, record_outcome
from sim.team.event import ContactKnown, MembersListed, Stored
from sim.team.invariant.durability import Slot
from sim.team.schedule import Schedule
from sim.team.workload import Workload

KEYS = [hash_key(f"key {number}") for number in range(4)]
NAMES = ("a", "b")


class Records(Workload):
    """Each node has a client that writes its own slots under a few keys, and reads all slots."""

    def __init__(self, schedule: Schedule) -> None:
        self._schedule = schedule
        self._history = schedule.history
        self._rng = schedule.rng
        self._clients = Clients(schedule.history)
        self._held: dict[tuple[int, int, Slot], tuple[int, bytes]] = {}
        self._met: dict[int, set[Contact]] = {}
        self._old: list[Record] = []
        schedule.team.watch_lives(lambda place, node: self._met.update({place: set()}), lambda place, node: None)
        if schedule.lying_place is not None:
            self._let_lie(schedule.node(schedule.lying_place))

    def step(self) -> None:
        """Perform a few operations at random nodes; inspect each store and routing table."""
        alive = self._schedule.alive()
        for _ in range(self._rng.randrange(3)):
            if alive:
                act = self._rng.choice([self._put, self._put, self._remove, self._read, self._read, self._meddle])
                act(self._rng.choice(alive))
        self._look()

    def make_final_requests(self) -> None:
        """Let all nodes read all keys and look up a few ids."""
        self._look()
        for place in self._schedule.alive():
            for key in KEYS:
                self._get(place, key, "majority")
                self._get(place, key, "fast")
            for target in KEYS[:2]:
                self._find(place, target)

    def find_violations(self) -> list[str]:
        """Record the members that each node knows."""
        for place in self._schedule.alive():
            known = self._schedule.node(place).overlay.members.list_live()
            self._history.record(MembersListed, place, tuple(contact.node_id for contact in known))
        return []

    # -- operations of clients --------------------------------------------------------------------------------------

    def _put(self, place: int) -> None:
        key, name = self._rng.choice(KEYS), self._rng.choice(NAMES)
        concern: Any = self._rng.choice(["majority", "majority", "majority", "all"])
        self._clients.write(place, self._schedule.node(place), key, name, concern)

    def _remove(self, place: int) -> None:
        node = self._schedule.node(place)
        mine = self._clients.list_slots(node.identity.public)
        if mine:
            slot = self._rng.choice(mine)
            self._clients.write(place, node, slot.key, slot.name, act=REMOVE)

    def _read(self, place: int) -> None:
        self._get(place, self._rng.choice(KEYS), self._rng.choice(["majority", "majority", "fast"]))

    def _get(self, place: int, key: bytes, concern: Any) -> None:
        life = self._schedule.team.life_numbers[place]
        self._clients.read(place, life, self._schedule.node(place), key, concern).addCallback(self._keep)

    def _keep(self, records: list[Record]) -> None:
        self._old += [record for record in records if len(self._old) < 50]

    def _find(self, place: int, target: bytes) -> None:
        asked = self._history.record_request(place, "look up", target, K)
        looking = self._schedule.node(place).find_node(target)
        record_outcome(self._history, asked, looking, lambda found: tuple(contact.node_id for contact in found))

    def _meddle(self, place: int) -> None:
        """Let a member send an old record of another member, and a forged record."""
        if not self._old:
            return
        node = self._schedule.node(place)
        old = self._rng.choice(self._old)
        made_up = Record(old.key, old.name, old.owner, old.sequence + 99, "team", 60.0, b"77777", old.signature)
        for contact in node.overlay.find_responsible(old.key):
            if contact.node_id != node.identity.node_id:
                asked = node.endpoint.ask(contact, "store", [old.pack()], [old.ttl], changes=True)
                asked.addErrback(_weather)
                if contact.public != old.owner and node.identity.public != old.owner:
                    forged = node.endpoint.ask(contact, "store", [made_up.pack()], [60.0], changes=True)
                    forged.addErrback(_weather)

    def _let_lie(self, node: EntangledNode) -> None:
        """Let a member reply to lookups with contacts that do not exist."""
        ghosts = [Identity(bytes([n]) * 32) for n in range(200, 204)]
        named = [[ghost.public, "10.9.9.9", 9000 + n] for n, ghost in enumerate(ghosts)]
        node.endpoint.expose("find_node", lambda peer, target: named)
        node.endpoint.expose("members", lambda peer, after: [] if after else named)

    # -- observations -----------------------------------------------------------------------------------------------

    def _look(self) -> None:
        team = self._schedule.team
        for place in self._schedule.alive():
            met = self._met[place]
            for contact in self._schedule.node(place).overlay.contacts():
                if contact not in met:
                    met.add(contact)
                    self._history.record(ContactKnown, place, contact.public, str(contact.address))
            memory = team.get_store_number(place)
            for record in team.stores[place].records():
                at, mark = (place, memory, Slot(*record.slot)), (record.sequence, record.signature)
                if mark != self._held.get(at):
                    self._held[at] = mark
                    is_lasting = record.lifetime == "team"
                    is_genuine = not is_lasting or record.is_genuine()
                    self._history.record(Stored, place, memory, at[2], record.name, *mark, is_lasting, is_genuine)


def _weather(failure: Failure) -> None:
    failure.trap(EntangledError)
