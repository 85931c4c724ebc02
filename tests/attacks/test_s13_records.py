"""Attack S13: store records of uncertified or revoked owners, or more records than an owner's share permits."""

from __future__ import annotations

import random
from typing import Any

import msgpack

from middleware.admission.roles import DEVICE, OPERATOR, VIEWER
from middleware.entangled.identity import Identity
from middleware.entangled.record import Record, hash_key
from middleware.entangled.replication.watch import Watch
from middleware.entangled.space.tuplespace import TupleSpace
from middleware.stop.stop_set import Statement
from middleware.stop.stop_state import SLOT, STOPS_KEY
from middleware.tasks.task import TASKS
from tests.attacks.siege import SOURCE, SiegeCase
from tests.middleware.admission.village import House, Village

JUNK = 12_400
PAGE = 60
OTHER = hash_key("whatever")
STOP = bytes(range(16))


def written(owner: Identity, key: bytes, name: str, value: bytes = b"\xc3", sequence: int = 1) -> Record:
    """Return a record that outlives its owner, with the owner's valid signature."""
    return Record(key, name, owner.public, sequence, "team", 3600.0, value).sign(owner)


class RecordCase(SiegeCase):
    """A team of four connected nodes."""

    def setUp(self) -> None:
        super().setUp()
        self.team: Village = self.village()
        for name in ("dog1", "dog2", "dog3"):
            self.team.enlist(name, DEVICE)
        self.team.run(10.0)

    def forged(self, owner: Identity) -> list[Record]:
        """Return three records signed by ``owner``: a release of a stop, a task and one record of another kind."""
        release = msgpack.packb(Statement({}, (STOP,), "nobody").pack())
        return [written(owner, STOPS_KEY, SLOT, release), written(owner, TASKS, "t1"), written(owner, OTHER, "x")]

    def holders(self, records: list[Record], among: list[House]) -> list[str]:
        """Return the nodes that store at least one of the records."""
        return [h.name for h in among if any(h.node.store.get_slot(record.slot) is not None for record in records)]

    def read(self, records: list[Record], house: House) -> list[Record]:
        """Return the given records that a node reads at the consistency level majority."""
        keys = dict.fromkeys(record.key for record in records)
        found = [self.outcome(self.team, house.node.get(key)) for key in keys]
        return [record for each in found for record in each if record in records]

    def watch(self, records: list[Record], house: House) -> list[Watch]:
        """Watch the keys of the records at a node."""
        keys = dict.fromkeys(record.key for record in records)
        return [house.node.watch(key, lambda found: None, keep=True) for key in keys]

    def works(self, house: House) -> None:
        """Check that a node can write a record and a tuple, and publish an invitation."""
        put = house.node.put(hash_key("own"), "slot", b"\xc3")
        self.assertGreaterEqual(self.outcome(self.team, put), 3)
        space = TupleSpace(house.node, self.team.clock, random.Random(7), "yard")
        self.addCleanup(space.stop)
        self.assertIsNone(self.outcome(self.team, space.put(("ball", 1))))
        self.assertEqual(self.outcome(self.team, space.get_if_exists(("ball", int))), ("ball", 1))
        self.team.invite("pup")

    def accomplice(self) -> House:
        """Return a member with a modified node that accepts, transfers and returns any record."""
        house = self.team.houses[-1]
        house.node.replica.may_store = house.node.replica.may_stay = lambda slot: True
        return house


class InventedKeyTests(RecordCase):
    def setUp(self) -> None:
        super().setUp()
        self.invented = Identity(b"invented".ljust(32))
        self.records = self.forged(self.invented)

    def test_brought_by_a_viewer(self) -> None:
        """A viewer cannot store records signed with an invented key, by any method that accepts records."""
        team = self.team
        viewer, own = self.insider(team, "eye", VIEWER)
        viewer.expose("watch", lambda peer, key, digest, ttl=8.0: [0, [[], None]], changes=True)
        watches = [watch for house in team.houses for watch in self.watch(self.records, house)]
        for house in team.houses:
            node: Any = house.node
            for watch in node._subscriber._watches:
                watch.requested.add(own.node_id)
            contact = team.contact(house)
            for record in self.records:
                packed = [record.pack()]
                for method, arguments in (
                    ("store", (packed,)),
                    ("store", (packed, [600.0])),
                    ("cache", (record.key, packed, 60.0)),
                    ("push", (record.key, 1, packed, [])),
                ):
                    viewer.ask(contact, method, *arguments, changes=True).addErrback(lambda failure: None)
        team.run(0.5)
        self.assertEqual([record for watch in watches for record in watch.records], [])
        team.run(3.0)
        self.assertEqual(self.holders(self.records, team.houses), [])
        cached = [h.node.replica.cache.get(r.key, 0.0) for h in team.houses for r in self.records]
        self.assertEqual([copy for copy in cached if copy], [])
        self.assertEqual(self.read(self.records, team.houses[0]), [])

    def test_told_by_a_lying_replica(self) -> None:
        """A reader ignores records of uncertified owners in a malicious replica's replies."""
        team, house = self.team, self.team.houses[0]
        liar, _ = self.insider(team, "eye", VIEWER)
        by_key = {record.key: record for record in self.records}
        liar.expose("find_value", lambda peer, key, *rest: [[by_key[key].pack()], None, 1])
        liar.expose("watch", lambda peer, key, *rest: [1, [[by_key[key].pack()], None]], changes=True)
        liar.expose("fetch", lambda peer, slots: [[by_key[slot[0]].pack(), 600.0] for slot in slots])
        self.outcome(team, liar.ask(team.contact(house), "ping", bytes(8), changes=True))
        contact = next(iter([c for c in house.node.overlay.contacts() if c.address == SOURCE]), None)
        assert contact is not None
        node: Any = house.node
        for record in self.records:
            reading = node._background
            answers: list[Any] = []

            async def read(record: Record = record, answers: list[Any] = answers) -> None:
                answers.append(await node._reader.read_pages(contact, record.key))

            reading.fork(read())
            [watch] = self.watch([record], house)
            reading.fork(node._subscriber._renew_at(watch, contact))
            reading.fork(node._handover._fetch(contact, [record.slot]))
            team.run(1.0)
            self.assertEqual([answer.records for answer in answers], [[]])
            self.assertEqual(watch.records, [])
        self.assertEqual(self.holders(self.records, [house]), [])

    def test_handed_over_by_an_accomplice(self) -> None:
        """An accomplice's node that stores such records cannot transfer them.

        No read or watch at other nodes returns them.
        """
        team = self.team
        accomplice = self.accomplice()
        others = [house for house in team.houses if house is not accomplice]
        watches = [watch for house in others for watch in self.watch(self.records, house)]
        for record in self.records:
            accomplice.node.replica.store_locally(record)
        team.run(60.0)
        self.assertEqual(self.holders(self.records, [accomplice]), [accomplice.name])
        self.assertEqual(self.holders(self.records, others), [])
        self.assertEqual([record for watch in watches for record in watch.records], [])
        self.assertEqual([self.read(self.records, house) for house in others], [[], [], []])

    def test_a_flood_of_junk(self) -> None:
        """12,400 records under invented keys fill no store.

        Afterwards records, tuples and invitations can be written.
        """
        team = self.team
        viewer, _ = self.insider(team, "eye", VIEWER)
        junk = [written(self.invented, OTHER, f"{number}") for number in range(JUNK)]
        for house in team.houses:
            for begin in range(0, JUNK, PAGE):
                page = [record.pack() for record in junk[begin : begin + PAGE]]
                asked = viewer.ask(team.contact(house), "store", page, [600.0] * len(page), changes=True)
                asked.addErrback(lambda failure: None)
                team.run(0.05)
        team.run(2.0)
        self.assertEqual(self.holders(junk, team.houses), [])
        self.works(team.houses[1])


class RevokedKeyTests(RecordCase):
    def setUp(self) -> None:
        super().setUp()
        self.boss = self.team.enlist("boss", OPERATOR)
        self.team.enlist("dog4", DEVICE)
        self.team.run(10.0)
        self.others = [house for house in self.team.houses if house is not self.boss]
        self.outcome(self.team, self.boss.node.put(TASKS, "before", b"\xc3"))
        [self.before] = self.outcome(self.team, self.others[0].node.get(TASKS))
        self.later = written(self.boss.kept.membership.identity, TASKS, "later", sequence=2**40)

    def revoke(self) -> None:
        """Revoke the member, and stop its node."""
        self.team.tell(self.team.signer.revoke(self.boss.public, self.boss.name, self.team.wall()))
        self.team.run(10.0)
        self.team.close(self.boss, is_sudden=True)

    def test_what_it_ordered_before(self) -> None:
        """A revoked operator's records disappear from every store and watch when its revocation arrives."""
        watches = [watch for house in self.others for watch in self.watch([self.before], house)]
        self.team.run(3.0)
        self.assertEqual([watch.records for watch in watches], [[self.before]] * len(watches))
        self.revoke()
        self.assertEqual([watch.records for watch in watches], [[]] * len(watches))
        self.assertEqual(self.holders([self.before], self.others), [])
        self.assertEqual(self.read([self.before], self.others[0]), [])

    def test_its_stop_stays(self) -> None:
        """A stop by a later revoked operator stays in force, also across restarts.

        The revoked operator cannot release it.
        """
        stop = msgpack.packb(Statement({STOP: "boss"}).pack())
        self.outcome(self.team, self.boss.node.put(STOPS_KEY, SLOT, stop))
        self.revoke()
        sleeper = self.others[1]
        self.team.close(sleeper)
        self.team.open(sleeper)
        self.team.run(5.0)
        for house in self.others:
            found = self.outcome(self.team, house.node.get(STOPS_KEY))
            self.assertEqual([record.value for record in found], [stop], house.name)
        bad, _ = self.insider(self.team, "bad", DEVICE)
        lifted = msgpack.packb(Statement({}, (STOP,), "boss").pack())
        release = written(self.boss.kept.membership.identity, STOPS_KEY, SLOT, lifted, sequence=2**40)
        for house in self.others:
            bad.ask(self.team.contact(house), "store", [release.pack()], [600.0], changes=True)
        self.team.run(1.0)
        for house in self.others:
            self.assertNotEqual(house.node.store.get_slot(release.slot), release)

    def test_what_it_signs_afterwards(self) -> None:
        """Records that a member signs after its revocation are rejected, even if an accomplice's node sends them."""
        self.revoke()
        bad, _ = self.insider(self.team, "bad", DEVICE)
        for house in self.others:
            asked = bad.ask(self.team.contact(house), "store", [self.later.pack()], [600.0], changes=True)
            [decision] = self.outcome(self.team, asked, 0.5)
            self.assertLess(decision, 0)
        accomplice = self.accomplice()
        accomplice.node.replica.store_locally(self.later)
        honest = [house for house in self.others if house is not accomplice]
        self.team.run(60.0)
        self.assertEqual(self.holders([self.later], honest), [])
        self.assertEqual(self.read([self.later], honest[0]), [])

    def test_after_a_restart(self) -> None:
        """A node that was off during the revocation deletes the member's records when it learns of the revocation."""
        sleeper = self.others[1]
        self.team.close(sleeper)
        self.revoke()
        self.assertEqual(self.holders([self.before], [sleeper]), [sleeper.name])
        self.team.open(sleeper)
        self.team.run(12.0)
        self.assertEqual(self.holders([self.before], self.others), [])
        self.team.close(sleeper)
        sleeper.node.store.put(self.later, self.team.clock.seconds() + 600.0)
        self.team.open(sleeper)
        self.assertEqual(sleeper.node.replica.get_held(TASKS), [])
        self.team.run(12.0)
        self.assertEqual(self.holders([self.later], self.others), [])
        self.assertEqual(self.read([self.later], sleeper), [])


class FloodTests(RecordCase):
    def test_it_fills_its_own_share_only(self) -> None:
        """A device that floods every store fills only its own share; all other members can still write."""
        team = self.team
        bad, own = self.insider(team, "bad", DEVICE)
        names = [f"{number}" for number in range(JUNK)]
        junk = [Record(OTHER, name, own.public, 1, "team", 3600.0, b"\xc3", bytes(64)).pack() for name in names]
        refused = 0
        for house in team.houses:
            for begin in range(0, JUNK, PAGE):
                asked = bad.ask(team.contact(house), "store", junk[begin : begin + PAGE], changes=True)
                decisions = self.outcome(team, asked, 0.05)
                refused += not isinstance(decisions, list) or any(decisions)
            usage = house.node.store.usage
            self.assertLessEqual(usage.rows, usage.max_rows // 2)
        self.assertGreater(refused, 0)
        self.works(team.houses[1])
        first = Record(OTHER, names[0], own.public, 2, "team", 3600.0, None, bytes(64))
        asked = bad.ask(team.contact(team.houses[0]), "store", [first.pack()], changes=True)
        self.assertEqual(self.outcome(team, asked), [0], "a full owner can still delete")

    def test_it_blocks_no_reads(self) -> None:
        """If a member's share is full at all replicas except one, reads of the key still succeed."""
        team = self.team
        bad, own = self.insider(team, "bad", OPERATOR)
        for house in team.houses[1:]:
            usage = house.node.store.usage
            for number in range((usage.max_rows - usage.rows) // 2):
                house.node.replica.store_locally(
                    Record(OTHER, f"{number}", own.public, 1, "team", 3600.0, b"\xc3", bytes(64))
                )
        record = written(own, TASKS, "t1")
        asked = bad.ask(team.contact(team.houses[0]), "store", [record.pack()], changes=True)
        self.assertEqual(self.outcome(team, asked), [0])
        for house in team.houses:
            found = self.outcome(team, house.node.get(TASKS), 5.0)
            self.assertIsInstance(found, list)


class GuestTests(RecordCase):
    def test_second_hand(self) -> None:
        """A node that joins after a guest has left accepts the guest's record, also after the node has restarted."""
        team = self.team
        guest = team.move_in(team.houses[0].team.create_guest(bytes(range(32)), "phone"))
        team.run(5.0)
        self.outcome(team, guest.node.put(OTHER, "note", b"\xc3"))
        [record] = self.outcome(team, guest.node.get(OTHER))
        team.run(5.0)
        team.close(guest)
        team.run(5.0)
        late = team.enlist("late", DEVICE)
        team.run(30.0)
        self.assertEqual(late.node.replica.get_held(OTHER), [record])
        self.assertEqual(self.read([record], late), [record])
        for house in team.houses:
            if house is not guest:
                team.close(house)
        team.open(late)
        self.assertEqual(late.node.replica.get_held(OTHER), [record])
