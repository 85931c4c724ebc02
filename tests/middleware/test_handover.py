"""Tests of the hand-over of records to new holders, and of the reconciliation between two replicas."""

from __future__ import annotations

from collections import Counter
from typing import Any

from twisted.internet.defer import Deferred, succeed

from middleware.entangled.background import run_limited
from middleware.entangled.errors import NoAnswer, Refused
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import TEAM_TTL_S, Record, hash_key
from middleware.entangled.replication.comparison import GROUPS, PAGE_RECORDS, SIGNATURE_BITS, SNAPSHOT_S
from tests.fleet import EntangledTeam, FleetCase

KEY = hash_key("colour")
MANY = 2000
HOUR = 3600.0


def counted(node: EntangledNode) -> Counter[str]:
    """Return a counter of later requests of ``node`` by method, and of the records in its store requests."""
    seen: Counter[str] = Counter()
    ask = node.overlay.ask

    def counting(contact: Any, method: str, *arguments: Any, **how: Any) -> Any:
        seen[method] += 1
        seen["records"] += len(arguments[0]) if method == "store" else 0
        return ask(contact, method, *arguments, **how)

    node.overlay.ask = counting  # type: ignore[method-assign]
    return seen


class LifeTests(FleetCase):
    """Tests of the remaining TTL of records that a node other than their owner has forwarded."""

    def left(self, fleet: EntangledTeam, place: int, name: str = "a") -> float:
        """Return the remaining seconds of a record of node 0 at the node with index ``place``."""
        slot = Record(KEY, name, fleet.identity(0).public, 1, "team", 1.0, b"").slot
        expiry = fleet.stores[place].find_expiry(slot)
        return 0.0 if expiry is None else expiry - fleet.clock.seconds()

    def newcomer_that_meets_a_liar(self, told: float) -> EntangledTeam:
        """Return five nodes; node 1 falsely states a remaining TTL of ``told`` for all records.

        The last node joined through node 1 only.
        """
        fleet = self.fleet(4)
        for number in range(40):
            fleet.nodes[0].put(KEY, "a" if not number else f"other {number}", b"x", "team", "all")
        fleet.run(1.0)
        fleet.nodes[1].replica.remaining_lifetime = lambda record: told  # type: ignore[method-assign]
        fleet.switchboard.partition([fleet.address(place) for place in (1, 4)])
        fleet.nodes.append(fleet.make_node(4))
        fleet.start_node(fleet.nodes[4], [fleet.address(1)])
        fleet.run(2.5)
        self.assertLess(abs(self.left(fleet, 4) - told), 3.0)
        fleet.switchboard.heal()
        return fleet

    def test_a_liar_shortens_no_life(self) -> None:
        """If a new node received a record with a false, short TTL, it learns the longer TTL from an honest replica."""
        fleet = self.newcomer_that_meets_a_liar(2 * HOUR)
        fleet.run(30.0)
        self.assertGreater(self.left(fleet, 4), TEAM_TTL_S - 60.0)

    def test_nor_behind_records_of_its_own(self) -> None:
        """The TTLs that a malicious node shortened are corrected, even if it also has records with long TTLs."""
        fleet = self.newcomer_that_meets_a_liar(2 * HOUR)
        liar = fleet.identity(1)
        for number in range(60):
            made = Record(KEY, f"mask {number}", liar.public, 1, "team", 20 * TEAM_TTL_S, b"x").sign(liar)
            for place in range(5):
                fleet.nodes[place].replica.store_locally(made, None if place == 4 else HOUR)
        fleet.run(60.0)
        self.assertGreater(self.left(fleet, 4), TEAM_TTL_S - 120.0)
        self.assertLessEqual(self.left(fleet, 4), TEAM_TTL_S)

    def test_lives_do_not_creep(self) -> None:
        """Repeated reconciliation extends no TTL: a record expires at most one TTL after its owner failed."""
        fleet = self.fleet(4)
        self.done(fleet, fleet.nodes[0].put(KEY, "a", b"x", "team", "all"), 1.0)
        fleet.nodes[0].stop_silently()
        began = fleet.clock.seconds()
        fleet.run(600.0)
        for place in (1, 2, 3):
            self.assertLess(self.left(fleet, place) + fleet.clock.seconds() - began, TEAM_TTL_S + 1.0)

    def test_a_life_names_the_very_record(self) -> None:
        """A stated TTL is ignored if it is for another record of the slot, and is limited to the maximum TTL."""
        fleet = self.fleet(2)
        self.done(fleet, fleet.nodes[0].put(KEY, "a", b"x", "team", "all"), 1.0)
        handover: Any = fleet.nodes[1]._handover
        [record] = fleet.nodes[1].replica.get_held(KEY)
        fleet.clock.advance(100.0)
        handover._extend_life(record.slot, (record.sequence, b"anothers"), TEAM_TTL_S)
        self.assertLess(self.left(fleet, 1), TEAM_TTL_S - 90.0)
        handover._extend_life(record.slot, (record.sequence, record.signature[:8]), 9e9)
        self.assertLess(abs(self.left(fleet, 1) - TEAM_TTL_S), 1.0)


class GivingTests(FleetCase):
    """Tests of records that a node hands over to their holders."""

    def test_only_what_is_lacking(self) -> None:
        """A node hands over each missing record once, and then sends nothing more."""
        fleet = self.fleet(12)
        stranger = fleet.identity(99)
        made = [Record(hash_key(str(n)), "a", stranger.public, 1, "team", HOUR, b"x").sign(stranger) for n in range(60)]
        giver = fleet.nodes[0]
        extra = [r for r in made if not giver.overlay.is_replica(r.key, giver.contact)]
        self.assertGreater(len(extra), 10)
        for record in extra:
            giver.replica.store_locally(record)
        fleet.run(120.0)
        peer = next(
            node for node in fleet.nodes[1:] if sum(node.overlay.is_replica(r.key, node.contact) for r in extra) > 5
        )
        there = [r for r in extra if peer.overlay.is_replica(r.key, peer.contact)]
        self.assertEqual([r for r in there if not peer.replica.get_held(r.key)], [])
        handover: Any = giver._handover
        self.reconcile(fleet, handover, peer)
        seen = counted(giver)
        self.reconcile(fleet, handover, peer)
        self.assertEqual((seen["records"], seen["lacking"]), (0, 0))
        # A further record is handed over alone.
        more = Record(there[0].key, "b", stranger.public, 1, "team", HOUR, b"x").sign(stranger)
        giver.replica.store_locally(more)
        self.reconcile(fleet, handover, peer)
        self.assertEqual(seen["records"], 1)
        self.assertEqual([r.name for r in peer.replica.get_held(more.key)], ["a", "b"])

    def reconcile(self, fleet: EntangledTeam, handover: Any, peer: EntangledNode) -> None:
        fleet.run(0.5)
        self.done(fleet, Deferred.fromCoroutine(handover._reconcile(peer.contact)), 0.5)


class ManyTests(FleetCase):
    """Tests of thousands of records of one owner, and of reads of many records."""

    def test_a_holder_reads_no_record_again(self) -> None:
        """When a replica reads by majority, only digests are transferred if the replicas agree, otherwise records."""
        fleet = self.fleet(5)
        for number in range(300):
            fleet.nodes[0].put(KEY, str(number), b"x" * 100, "team", "all")
        fleet.run(3.0)

        def cost(expected: int) -> int:
            before = fleet.switchboard.counters["sent"]
            self.assertEqual(len(self.done(fleet, fleet.nodes[1].get(KEY), 0.2)), expected)
            return fleet.switchboard.counters["sent"] - before

        self.assertLess(cost(300), 25)
        owner = fleet.identity(0)
        newer = Record(KEY, "newer", owner.public, 2**40, "team", 60.0, b"y").sign(owner)
        for place in (0, 2, 3, 4):
            fleet.nodes[place].replica.store_locally(newer)
        self.assertGreater(cost(301), 60)
        fleet.run(40.0)  # the replicas reconcile during this time
        self.assertLess(cost(301), 25)

    def test_newcomers_get_all_leases(self) -> None:
        """Two thousand leased records reach each new node; no record is dropped because of congestion."""
        fleet = self.fleet(1)
        owner = fleet.nodes[0]
        for number in range(MANY):
            owner.put(KEY, str(number), b"x", "leased")
        fleet.run(0.5)
        self.assertEqual(len(owner.replica.get_held(KEY)), MANY)
        for place in (1, 2, 3):
            fleet.nodes.append(fleet.make_node(place))
            fleet.start_node(fleet.nodes[place], [fleet.address(0)])
        fleet.run(6.0)
        self.assertEqual([len(node.replica.get_held(KEY)) for node in fleet.nodes], [MANY] * 4)
        self.assertEqual(owner.endpoint.counters["crowded"], 0)

    def test_what_is_owed_is_paced(self) -> None:
        """Two thousand records that were written during a partition are replicated soon after the partition ends."""
        fleet = self.fleet(3)
        owner = fleet.nodes[0]
        fleet.switchboard.partition([fleet.address(0)])
        fleet.run(15.0)
        for number in range(MANY):
            owner.put(KEY, str(number), b"x", "team").addErrback(lambda failure: failure.trap(NoAnswer))
        fleet.run(4.0)
        fleet.switchboard.heal()
        self.assertEqual([len(node.replica.get_held(KEY)) for node in fleet.nodes], [MANY, 0, 0])
        fleet.run(25.0)
        self.assertEqual([len(node.replica.get_held(KEY)) for node in fleet.nodes], [MANY] * 3)
        self.assertEqual(owner.endpoint.counters["crowded"], 0)

    def test_paced(self) -> None:
        """``paced`` runs a limited number of coroutines at a time.

        An error does not stop the others, and no coroutine starts early.
        """
        begun: list[int] = []
        waiting: dict[int, Deferred[None]] = {}

        async def work(number: int) -> None:
            begun.append(number)
            if number == 2:
                raise NoAnswer("nobody there")
            await (succeed(None) if number == 3 else waiting.setdefault(number, Deferred()))

        done = Deferred.fromCoroutine(run_limited(2, (work(number) for number in range(6))))
        self.assertEqual(begun, [0, 1])
        waiting[1].callback(None)
        self.assertEqual(begun, [0, 1, 2, 3, 4])
        waiting[0].callback(None)
        self.assertEqual(begun, [0, 1, 2, 3, 4, 5])
        self.assertNoResult(done)
        for number in (4, 5):
            waiting[number].callback(None)
        self.successResultOf(done)


COUNT = 40


class ComparisonTests(FleetCase):
    def setUp(self) -> None:
        super().setUp()
        self.whole: EntangledTeam = self.fleet(3)
        for number in range(COUNT):
            self.whole.nodes[0].put(hash_key(str(number)), "state", b"%d" % number)
            self.whole.nodes[0].put(hash_key("0"), f"{number}", b"so that a part has several pages")
        self.whole.run(1.0)

    def ask(self, method: str, *arguments: object) -> Any:
        to = self.whole.nodes[2].contact
        return self.done(self.whole, self.whole.nodes[1].endpoint.ask(to, method, *arguments), 0.1)

    def places(self, group: int) -> list[list[Any]]:
        """Return the entries of all records of a group, page by page."""
        found: list[list[Any]] = []
        while True:
            page = self.ask("places", group, found[-1][:3] if found else [])
            found += page
            if len(page) < PAGE_RECORDS:
                return found

    def test_every_place_is_listed_once(self) -> None:
        """The pages of all groups list each record once, in order."""
        self.ask("digests", 7, 2)
        found = [self.places(group) for group in range(GROUPS)]
        for part in found:
            self.assertEqual(part, sorted(part))
            self.assertEqual(len(part), len({tuple(place[:3]) for place in part}))
        self.assertEqual({place[0] for part in found for place in part}, {hash_key(str(n)) for n in range(COUNT)})
        self.assertEqual(self.places(-1), [])

    def test_who_pages_sees_one_moment(self) -> None:
        """Pages are a snapshot: a record that was stored later is listed when the snapshot is renewed or too old."""
        late = hash_key("late")
        group = late[0] * GROUPS >> 8
        self.ask("digests", 7, 2)
        self.whole.nodes[0].put(late, "state", b"x")
        self.whole.run(0.1)
        self.assertNotIn(late, [place[0] for place in self.places(group)])
        self.whole.run(SNAPSHOT_S)
        self.assertIn(late, [place[0] for place in self.places(group)])

    def test_records_come_in_pages(self) -> None:
        """A page contains records up to its size limit, at least one record, and None for each missing record."""
        node = self.whole.nodes[0]
        large = hash_key("large")
        for name in "abc":
            node.put(large, name, b"x" * 9000)
        self.whole.run(1.0)
        slots: list[object] = [[large, node.identity.public, name] for name in "abc"]
        self.assertEqual([fields[0][1] for fields in self.ask("fetch", slots)], ["a"])
        missing: list[object] = [[large, node.identity.public, "z"]]
        self.assertEqual(self.ask("fetch", missing * 3), [None] * 3)
        self.assertEqual(len(self.ask("fetch", [*missing * 20, *slots])), PAGE_RECORDS)
        self.assertEqual(self.ask("fetch", []), [])

    def test_wrong_questions(self) -> None:
        """Invalid groups, cursors and slots are rejected."""
        to, requester = self.whole.nodes[2].contact, self.whole.nodes[1].endpoint
        wrong: list[tuple[object, ...]] = [
            ("digests", SIGNATURE_BITS, 2),
            ("places", GROUPS, []),
            ("places", 0, [b"", b""]),
            ("fetch", [[b"", b""]]),
            ("fetch", [[b"", b"", 1]]),
            ("fetch", ["x"]),
            ("lacking", ["x"]),
            ("lacking", [[b"", b"", "", 1]]),
        ]
        for method, *arguments in wrong:
            asked = requester.ask(to, str(method), *arguments)
            self.whole.run(0.1)
            self.failureResultOf(asked, Refused)


class JoinTests(FleetCase):
    """Tests of joining: the cost until the first read, and the hand-over after it."""

    def test_a_newcomer_reads_at_once(self) -> None:
        """In a team of 20 the first read of a new node takes few datagrams, whatever its bootstrap node is."""
        fleet = self.fleet(20)
        keys = [hash_key(str(number)) for number in range(6)]
        for key in keys:
            fleet.nodes[3].put(key, "state", b"old")
        fleet.run(2.0)
        for key in keys:
            newcomer = fleet.make_node(len(fleet.nodes))
            fleet.nodes.append(newcomer)
            fleet.run(1.0)
            before = fleet.switchboard.counters["sent"]
            joined: Any = fleet.start_node(newcomer, [fleet.address(0)])
            read = joined.addCallback(lambda _, newcomer=newcomer, key=key: newcomer.get(key, "fast"))
            fleet.run(0.002)
            self.assertEqual([record.value for record in self.successResultOf(read)], [b"old"])
            self.assertLess(fleet.switchboard.counters["sent"] - before, 60)
            fleet.run(3.0)

    def test_a_newcomer_takes_over(self) -> None:
        """Within a second a new node knows all members, is synced and stores its share of the records."""
        fleet = self.fleet(10)
        keys = [hash_key(str(number)) for number in range(60)]
        for key in keys:
            fleet.nodes[3].put(key, "state", b"old")
        fleet.run(2.0)
        newcomer = fleet.add()
        fleet.run(1.0)
        self.assertTrue(newcomer.overlay.is_complete)
        self.assertTrue(newcomer.replica.is_synced())
        belongs = [key for key in keys if newcomer.overlay.is_replica(key, newcomer.contact)]
        self.assertGreater(len(belongs), 20)
        self.assertEqual([key for key in keys if newcomer.replica.get_held(key)], belongs)

    def test_a_newcomer_writes_to_the_right_nodes(self) -> None:
        """A majority write immediately after joining is found by a majority read at another node."""
        fleet = self.fleet(20)
        for number in range(6):
            newcomer = fleet.make_node(len(fleet.nodes))
            fleet.nodes.append(newcomer)
            key = hash_key(f"new {number}")
            stored: Any = fleet.start_node(newcomer, [fleet.address(0)])
            stored.addCallback(lambda _, newcomer=newcomer, key=key: newcomer.put(key, "state", b"new"))
            fleet.run(1.0)
            self.assertGreaterEqual(self.successResultOf(stored), 5)
            read = fleet.nodes[number].get(key)
            self.assertEqual([record.value for record in self.done(fleet, read, 0.5)], [b"new"])
