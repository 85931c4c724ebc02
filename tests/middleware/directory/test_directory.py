"""Tests of the directory while a team grows, shrinks, is partitioned and heals: each device is listed once.

Most tests simulate many devices over one table of records with expiring leases. The last tests use real nodes.
"""

from __future__ import annotations

import random
from collections.abc import Iterable
from typing import Any, cast

from twisted.internet.defer import Deferred, fail, succeed

from middleware.directory.directory import Directory, Page
from middleware.directory.listing import Listing
from middleware.directory.prefix import MAX_UNDIVIDED, compute_prefix
from middleware.directory.presence import DEVICES, Device, parse_device, parse_devices
from middleware.entangled.background import Background
from middleware.entangled.clock import HeapClock
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Unavailable
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.distance import select_closest
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, Slot
from tests.fleet import FleetCase, SwarmTeam

REVIEW = 10.0


class Table:
    """The records of all replicas on one side of a partition; reads of the keys in ``silent`` fail."""

    def __init__(self, clock: HeapClock) -> None:
        self.clock = clock
        self.slots: dict[Slot, tuple[Record, float]] = {}
        self.silent: set[bytes] = set()
        self.reads = 0

    def get(self, key: bytes, concern: str = "majority") -> Deferred[list[Record]]:
        self.reads += 1
        if key in self.silent:
            return fail(Unavailable(0, 5))
        now = self.clock.seconds()
        live = [record for slot, (record, until) in self.slots.items() if slot.key == key and until > now]
        return succeed(sorted(live, key=lambda record: record.owner))

    def keys(self) -> dict[bytes, int]:
        """Return the number of records under each key."""
        counts: dict[bytes, int] = {}
        for slot, (_, until) in self.slots.items():
            if until > self.clock.seconds():
                counts[slot.key] = counts.get(slot.key, 0) + 1
        return counts


class Members:
    """The part of a member table that the directory uses."""

    is_full = False


class Neighbour:
    """A device with its directory over a table, and the contacts that its node would have in a real network."""

    def __init__(self, town: Town, number: int) -> None:
        self.town = town
        self.table = town.table
        self.identity = Identity(random.Random(f"{town.seed}/{number}").randbytes(32))
        self.contact = Contact(self.identity.public, Address("10.0.0.1", 1 + number))
        self.lease = 1.0
        self.overlay = self
        self.members = Members()
        self.has_found_neighbours = True
        self.sequence = 0
        self.own: dict[Slot, float] = {}
        self.background = Background(town.clock)
        self.directory = Directory(cast(EntangledNode, self), self.background)

    @property
    def is_large(self) -> bool:
        """Whether the team is too large for the node to know every member."""
        return len(self.seen()) >= MAX_UNDIVIDED

    @property
    def is_complete(self) -> bool:
        return not self.is_large

    def seen(self) -> list[Contact]:
        return [n.contact for n in self.town.neighbours if n.table is self.table and n is not self]

    def contacts(self) -> list[Contact]:
        """Return the nearest contacts, or in a small team all contacts."""
        seen = self.seen()
        if len(seen) < MAX_UNDIVIDED:
            return seen
        return select_closest(seen, self.identity.node_id, 8)

    def get(self, key: bytes, concern: str = "majority") -> Deferred[list[Record]]:
        return self.table.get(key, concern)

    def put(self, key: bytes, name: str, value: bytes, lifetime: str, lease: float) -> Deferred[None]:
        """Write a record, or renew its lease; the lease starts now."""
        self.sequence += 1
        slot = Slot(key, self.identity.public, name)
        record = Record(key, name, self.identity.public, self.sequence, "leased", lease, value, bytes(64))
        self.own[slot] = lease
        self.table.slots[slot] = (record, self.town.clock.seconds() + lease)
        return succeed(None)

    def release(self, key: bytes, name: str) -> None:
        self.own.pop(Slot(key, self.identity.public, name))

    def say(self) -> None:
        """Announce the device at its current depth."""
        device = Device(self.identity.node_id.hex(), "d", depth=self.directory.depth)
        self.directory.announce("d", device.pack(), device.depth)

    def enter(self) -> None:
        """Join the team, and check the depth periodically."""
        Deferred.fromCoroutine(self.directory.choose_initial_depth())
        self.say()
        self.background.later(self.town.dice.uniform(0.0, REVIEW), self.review)
        self.background.every(0.8 * self.lease, self.beat)

    def review(self) -> None:
        """Change the depth if the size of the team requires this."""
        self.background.later(REVIEW, self.review)
        before = self.directory.depth
        if self.directory.update_depth() != before:
            self.say()

    def beat(self) -> None:
        """Renew this device's records in the current table."""
        for slot, lease in self.own.items():
            if slot in self.table.slots:
                record, _ = self.table.slots[slot]
                self.table.slots[slot] = (record, self.town.clock.seconds() + lease)


class Town:
    """Neighbours that join and leave, on one clock and with one table, or with two tables during a partition."""

    def __init__(self, seed: int = 1) -> None:
        self.seed = seed
        self.clock = HeapClock()
        self.dice = random.Random(f"{seed}/town")
        self.table = Table(self.clock)
        self.neighbours: list[Neighbour] = []
        self.number = 0

    def come(self, count: int, pause: float) -> None:
        """Let ``count`` neighbours join one after the other."""
        for _ in range(count):
            self.number += 1
            self.neighbours.append(Neighbour(self, self.number))
            self.neighbours[-1].enter()
            self.clock.advance(pause)

    def go(self, gone: Iterable[Neighbour]) -> None:
        """Remove neighbours without a goodbye."""
        for neighbour in list(gone):
            neighbour.background.stop()
            self.neighbours.remove(neighbour)

    def cut(self, away: Iterable[Neighbour]) -> None:
        """Give the neighbours in ``away`` a separate table from now on."""
        other = Table(self.clock)
        other.slots = dict(self.table.slots)
        for neighbour in away:
            neighbour.table = other

    def heal(self) -> None:
        """Merge the tables; the newer record of each slot wins."""
        for table in {id(n.table): n.table for n in self.neighbours if n.table is not self.table}.values():
            for slot, (record, until) in table.slots.items():
                known = self.table.slots.get(slot)
                if known is None or (record.sequence, until) > (known[0].sequence, known[1]):
                    self.table.slots[slot] = (record, until)
        for neighbour in self.neighbours:
            neighbour.table = self.table


def result(case: FleetCase, work: Any) -> Any:
    """Return the result of a coroutine or Deferred that has completed."""
    return case.successResultOf(work if isinstance(work, Deferred) else Deferred.fromCoroutine(work))


class DirectoryTests(FleetCase):
    def listed(self, reader: Neighbour) -> list[bytes]:
        """Return the ids that ``reader`` lists, without removing duplicates."""
        listing: Listing = result(self, reader.directory.list_devices())
        self.assertTrue(listing.is_complete)
        return [parse_device(record).uuid for record in listing.records]  # type: ignore[union-attr, misc]

    def all_there(self, town: Town, readers: int = 3, also: Iterable[Neighbour] = ()) -> None:
        """Check that ``readers`` list each present device once, and no departed device except those in ``also``."""
        here = {n.identity.node_id.hex() for n in town.neighbours}
        late = {n.identity.node_id.hex() for n in also}
        for reader in town.dice.sample(town.neighbours, min(readers, len(town.neighbours))):
            listed = self.listed(reader)
            self.assertEqual(len(listed), len(set(listed)), "somebody is listed twice")
            self.assertEqual(here - set(listed), set(), "somebody is missing")
            self.assertEqual(set(listed) - here - late, set(), "somebody is listed who left")

    def all_stay(self, town: Town, readers: int = 2, times: int = 12, pause: float = 5.0) -> None:
        """Repeat ``all_there`` ``times`` times, every ``pause`` seconds."""
        for _ in range(times):
            town.clock.advance(pause)
            self.all_there(town, readers)

    def test_growth_and_back(self) -> None:
        """While the team grows from 3 devices to 300 and shrinks again, each device is listed once.

        In the end there is one key.
        """
        town = Town()
        town.come(3, 1.0)
        self.assertEqual(set(town.table.keys()), {DEVICES})
        while len(town.neighbours) < 300:
            town.come(9, 0.4)
            self.all_there(town, 2)
        self.assertGreater(min(n.directory.depth for n in town.neighbours), 1)
        town.clock.advance(60.0)
        self.assertLess(max(town.table.keys().values()), 80)
        while len(town.neighbours) > 12:
            gone = town.dice.sample(town.neighbours, 9)
            town.go(gone)
            self.all_there(town, 1, gone)
            town.clock.advance(max(n.directory.lease for n in gone))
            self.all_there(town, 2)
        town.clock.advance(10 * REVIEW + 60.0)
        self.assertEqual({n.directory.depth for n in town.neighbours}, {0})
        self.assertEqual(town.table.keys(), {DEVICES: len(town.neighbours)})

    def test_partition_and_healing(self) -> None:
        """Each side of a partition lists its own devices.

        After the partition ends, all devices are listed immediately.
        """
        town = Town(4)
        town.come(240, 0.1)
        town.clock.advance(60.0)
        away = town.dice.sample(town.neighbours, 20)
        town.cut(away)
        town.clock.advance(200.0)
        few = self.listed(away[0])
        self.assertEqual(set(few), {n.identity.node_id.hex() for n in away})
        self.assertEqual({n.directory.depth for n in away}, {0})
        self.assertEqual(len(self.listed(next(n for n in town.neighbours if n not in away))), 220)
        town.heal()
        self.all_there(town, 5)
        self.all_stay(town)

    def test_a_place_whose_holders_are_lost(self) -> None:
        """A newcomer reads one prefix of its neighbourhood.

        If no replica of the prefix replies, the listing is incomplete.
        """
        town = Town(7)
        town.come(150, 0.1)
        town.clock.advance(60.0)
        reader, before = town.neighbours[100], town.table.reads
        around = result(self, reader.directory.read_neighbourhood())
        self.assertEqual(town.table.reads - before, 1)
        self.assertIn(reader.identity.public, [record.owner for record in around])
        self.assertLess(len(around), 60)
        victim = town.neighbours[5]
        key = compute_prefix(victim.identity.node_id, victim.directory.depth).key
        town.table.silent.add(key)
        listing: Listing = result(self, town.neighbours[0].directory.list_devices())
        self.assertFalse(listing.is_complete)
        seen = {record.owner for record in listing.records}
        for neighbour in town.neighbours:
            is_missed = any(place.has(neighbour.identity.node_id) for place in listing.missed)
            self.assertTrue(neighbour.identity.public in seen or is_missed)

    def test_some(self) -> None:
        """A page lists the whole team if there is one prefix, and a few prefixes otherwise.

        Successive pages cover the team.
        """
        town = Town(9)
        town.come(30, 0.1)
        reader, before = town.neighbours[7], town.table.reads
        page: Page = result(self, reader.directory.find_devices(5))
        self.assertEqual((len(page.records), page.next_id, town.table.reads - before), (30, None, 1))
        town.come(270, 0.1)
        town.clock.advance(60.0)
        before = town.table.reads
        page = result(self, reader.directory.find_devices(20))
        self.assertLess(town.table.reads - before, 20)
        self.assertTrue(20 <= len(page.records) < 150 and page.is_complete and page.next_id)
        self.assertIn(reader.identity.public, [record.owner for record in page.records])
        seen = {record.owner for record in page.records}
        for _ in range(40):
            if page.next_id is None:
                break
            page = result(self, reader.directory.find_devices(20, after=page.next_id))
            seen |= {record.owner for record in page.records}
        self.assertIsNone(page.next_id)
        self.assertEqual(seen, {n.identity.public for n in town.neighbours})
        # A search continues until the device is found, the directory ends or the limit of reads is reached.
        sought = town.neighbours[120].identity.node_id.hex()
        page = result(self, reader.directory.find_devices(1, lambda device: device.uuid == sought))
        self.assertEqual([device.uuid for device, _ in parse_devices(page.records)], [sought])
        page = result(self, reader.directory.find_devices(1, lambda device: device.name == "nobody"))
        self.assertEqual((page.records, page.next_id), ([], None))
        page = result(self, reader.directory.find_devices(1, lambda device: device.name == "nobody", most_reads=1))
        self.assertIsNotNone(page.next_id)


class TeamTests(FleetCase):
    def names(self, fleet: SwarmTeam, place: int) -> list[str]:
        """Return the names of all devices that a node lists."""
        listing = self.done(fleet, fleet.nodes[place].list_devices(), 1.0)
        self.assertTrue(listing.is_complete)
        return sorted(device.name for device, _ in listing.devices)

    def test_apart_and_together_again(self) -> None:
        """Real nodes at the depth of a large team are listed and watched completely, until they return to one key."""
        fleet = self.swarm(12, weather=LinkConditions(0.01))
        told: list[list[Record]] = []
        following = fleet.nodes[1].watch_devices(told.append)
        fleet.run(1.0)
        self.assertEqual(len(told[-1]), 12)
        for node in fleet.nodes:
            node.directory.depth = 3
            node.presence.change(depth=3)
        fleet.run(1.5)
        here = sorted(f"dog{n}" for n in range(12))
        self.assertEqual({n.presence.device.depth for n in fleet.nodes}, {3})
        self.assertEqual(self.names(fleet, 0), here)
        fleet.nodes[4].stop_silently()
        fleet.nodes[5].stopService()
        here = sorted(set(here) - {"dog4", "dog5"})
        fleet.run(9.0)
        while any(node.presence.device.depth for node in fleet.nodes if node.running):
            self.assertEqual(self.names(fleet, 7), here)
            self.assertEqual(sorted(device.name for device, _ in parse_devices(following.records)), here)
        fleet.run(8.0)
        self.assertEqual(self.names(fleet, 7), here)
        records = self.done(fleet, fleet.nodes[8].entangled.get(DEVICES), 1.0)
        self.assertEqual(sorted(device.name for device, _ in parse_devices(records)), here)
        self.assertEqual(sorted(device.name for device, _ in parse_devices(following.records)), here)
        following.stop()
        before = len(told)
        fleet.nodes[8].presence.add_message(1.0, "hello")
        fleet.run(5.0)
        self.assertEqual(len(told), before)
