"""Tests of ``EntangledNode``: a simulated team in virtual time on a switchboard."""

from __future__ import annotations

import random
from typing import Any

import msgpack

from middleware.entangled.contact import Contact
from middleware.entangled.errors import NoAnswer, NotRunning, Refused, TooLarge
from middleware.entangled.kademlia.distance import select_closest
from middleware.entangled.kademlia.overlay import K
from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.node import CONTACTS_NOTE, EntangledNode
from middleware.entangled.record import MAX_NAME_BYTES, MAX_VALUE_BYTES, Record, hash_key
from middleware.entangled.replication.replica import SWEEP_INTERVAL_S
from tests.fleet import EntangledTeam, FleetCase

KEY = hash_key("devices")
ROUGH = LinkConditions(delay_s=0.01, jitter_s=0.01, loss=0.3, duplicate=0.05, reorder=0.1)


class NodeCase(FleetCase):
    """A test case with helpers for these tests."""

    def values(self, fleet: EntangledTeam, place: int, key: bytes = KEY, within: float = 3.0) -> list[bytes | None]:
        return [record.value for record in self.done(fleet, fleet.nodes[place].get(key), within)]

    def watched(self, node: EntangledNode, **options: Any) -> list[list[bytes | None]]:
        """Start a watch; return a list that will contain all its notifications."""
        told: list[list[bytes | None]] = []
        node.watch(KEY, lambda records: told.append([r.value for r in records]), **options)
        return told


class VerbTests(NodeCase):
    def test_put_replace_and_remove(self) -> None:
        """All nodes find the last value in each slot of a key; a removed record stays removed."""
        fleet = self.fleet(4)
        self.assertGreaterEqual(self.done(fleet, fleet.nodes[1].put(KEY, "state", b"one")), 3)
        for node in fleet.nodes[:2]:
            self.done(fleet, node.put(KEY, "state", b"two"))
        for place in range(4):
            self.assertEqual(self.values(fleet, place), [b"two", b"two"])
        self.done(fleet, fleet.nodes[0].remove(KEY, "state"))
        self.assertEqual(self.values(fleet, 2), [b"two"])
        fleet.run(60.0)
        self.assertEqual(self.values(fleet, 3), [b"two"])
        self.done(fleet, fleet.nodes[0].put(KEY, "state", b"three"))
        self.assertEqual(set(self.values(fleet, 2)), {b"two", b"three"})

    def test_a_node_alone(self) -> None:
        """A single node stores, finds and watches its records, including leased ones."""
        fleet = self.fleet(1)
        told = self.watched(fleet.nodes[0])
        self.assertEqual(self.done(fleet, fleet.nodes[0].put(KEY, "state", b"one", "leased")), 1)
        self.assertEqual(self.values(fleet, 0), [b"one"])
        self.assertEqual(told, [[b"one"]])

    def test_wrong_calls_fly(self) -> None:
        """An invalid record raises immediately, and a stopped node raises ``NotRunning``."""
        fleet = self.fleet(1)
        node = fleet.nodes[0]
        self.assertRaises(TooLarge, node.put, KEY, "state", bytes(MAX_VALUE_BYTES + 1))
        self.assertRaises(TooLarge, node.put, KEY, "ä" * MAX_NAME_BYTES, b"")
        for call in (lambda: node.put(b"x", "s", b""), lambda: node.get(b"x"), lambda: node.watch(b"x", print)):
            self.assertRaises(ValueError, call)
        node.stop()
        for call in (
            *(lambda: node.put(KEY, "s", b""), lambda: node.get(KEY), lambda: node.watch(KEY, print)),
            lambda: node.call(node.contact, "ping"),
        ):
            self.assertRaises(NotRunning, call)

    def test_the_largest_record(self) -> None:
        """Records of maximum size with the longest names are read in pages, together with many small records."""
        fleet = self.fleet(2)
        for place in range(12):
            name = f"{place:02}" + "ä" * (MAX_NAME_BYTES // 2 - 1)
            fleet.nodes[0].put(KEY, name, bytes([place]) * (MAX_VALUE_BYTES if place < 3 else 1))
        fleet.run(1.0)
        self.assertEqual(len(self.values(fleet, 1)), 12)

    def test_earlier_life_is_stepped_over(self) -> None:
        """A node that lost its store can overwrite its earlier records, even if they have the same sequence number."""
        for writes in (1, 3):
            fleet = self.fleet(3, seed=writes)
            for number in range(writes):
                self.done(fleet, fleet.nodes[2].put(KEY, "state", b"old %d" % number))
            fleet.nodes[2].stop_silently()
            fleet.stores.pop(2)
            node = fleet.restart(2)
            fleet.run(1.0)
            first, second = node.put(KEY, "state", b"newer"), node.put(KEY, "state", b"newest")
            fleet.run(3.0)
            self.successResultOf(first)
            self.successResultOf(second)
            self.assertEqual(self.values(fleet, 0), [b"newest"])


class LeaseTests(NodeCase):
    def test_vanish_with_the_owner(self) -> None:
        """A leased record stays until its owner stops renewing.

        After a failure it expires within one lease and a sweep.
        """
        fleet = self.fleet(4)
        fleet.nodes[3].put(KEY, "state", b"here", "leased")
        fleet.run(30.0)
        told = self.watched(fleet.nodes[1])
        fleet.run(2.5)
        self.assertEqual(told, [[b"here"]])
        fleet.nodes[3].stop_silently()
        fleet.run(0.6)
        self.assertEqual(told, [[b"here"]])
        fleet.run(1.0 - 0.6 + 2 * SWEEP_INTERVAL_S)
        self.assertEqual(told, [[b"here"], []])
        self.assertEqual(self.values(fleet, 0), [])

    def test_two_die_at_once(self) -> None:
        """If a replica fails at the same time as the owner of a leased record, the record still expires."""
        fleet = self.fleet(4)
        for node in fleet.nodes[2:]:
            node.put(KEY, "state", b"here", "leased")
        told = self.watched(fleet.nodes[0])
        fleet.run(5.0)
        for node in fleet.nodes[2:]:
            node.stop_silently()
        fleet.run(1.0 + 2 * SWEEP_INTERVAL_S)
        self.assertEqual(told[-1], [])

    def test_goodbye(self) -> None:
        """A goodbye removes the leased records of a node immediately; the node can store them again later."""
        fleet = self.fleet(3)
        fleet.nodes[2].put(KEY, "state", b"here", "leased")
        told = self.watched(fleet.nodes[0])
        fleet.run(3.0)
        fleet.nodes[2].stop()
        fleet.run(0.05)
        self.assertEqual(told, [[b"here"], []])
        fleet.restart(2).put(KEY, "state", b"back", "leased")
        fleet.run(1.0)
        self.assertEqual(told[-1], [b"back"])

    def test_lost_replica_is_mended(self) -> None:
        """A replica that lost a leased record receives it again within a few renewals."""
        fleet = self.fleet(3)
        fleet.nodes[2].put(KEY, "state", b"here", "leased")
        fleet.run(1.0)
        fleet.stores[0].drop_leased(fleet.nodes[2].identity.public)
        fleet.run(1.5)
        self.assertEqual([r.value for r in fleet.stores[0].get(KEY)], [b"here"])

    def test_replica_lets_go_of_what_it_holds_in_vain(self) -> None:
        """If the owner no longer has a leased record, its replicas remove the record within a few renewals."""
        fleet = self.fleet(3)
        old = Record(KEY, "old", fleet.nodes[2].identity.public, 1, "leased", 1.0, b"old").sign(fleet.identity(2))
        fleet.nodes[2].put(KEY, "state", b"here", "leased")
        fleet.nodes[0].replica.store_locally(old)
        fleet.run(3.0)
        self.assertEqual([r.value for r in fleet.stores[0].get(KEY)], [b"here"])

    def test_short_silence_ends_no_lease(self) -> None:
        """A partition of half a lease removes no leased record.

        A longer partition removes them, and they return when the partition ends.
        """
        fleet = self.fleet(3)
        fleet.nodes[2].put(KEY, "state", b"here", "leased")
        told = self.watched(fleet.nodes[0])
        fleet.run(2.0)
        for seconds, expected in ((0.5, [[b"here"]]), (3.0, [[b"here"], []])):
            fleet.switchboard.partition([fleet.address(2)])
            fleet.run(seconds)
            fleet.switchboard.heal()
            self.assertEqual(told, expected)
            fleet.run(5.0)
        self.assertEqual(told, [[b"here"], [], [b"here"]])


class TeamRecordTests(NodeCase):
    def test_pass_from_hand_to_hand(self) -> None:
        """A record and a tombstone remain although all their first replicas leave one after the other."""
        fleet = self.fleet(3)
        self.done(fleet, fleet.nodes[0].put(KEY, "task", b"do it"))
        self.done(fleet, fleet.nodes[0].put(KEY, "gone", b"no"))
        self.done(fleet, fleet.nodes[0].remove(KEY, "gone"))
        for place in range(3):
            fleet.nodes.append(fleet.make_node(3 + place))
            fleet.start_node(fleet.nodes[-1], [fleet.address(place)])
            fleet.run(2.0)
            fleet.nodes[place].stop_silently()
            fleet.run(40.0)  # until the other nodes remove the node from the member table
        self.assertEqual(self.values(fleet, 5), [b"do it"])
        self.assertEqual(len(fleet.stores[5].get(KEY, tombstones=True)), 2)


class WatchTests(NodeCase):
    def test_changes_are_pushed(self) -> None:
        """A watcher receives each change immediately, without a further request."""
        fleet = self.fleet(3)
        told = self.watched(fleet.nodes[2])
        fleet.run(0.5)
        for value in (b"one", b"two"):
            fleet.nodes[0].put(KEY, "state", value)
            fleet.run(0.05)
        fleet.nodes[0].remove(KEY, "state")
        fleet.run(0.05)
        self.assertEqual(told, [[b"one"], [b"two"], []])

    def test_end_of_the_node_is_no_news(self) -> None:
        """A node that stops does not notify its subscribers that records were removed."""
        fleet = self.fleet(3)
        told = self.watched(fleet.nodes[2])
        fleet.nodes[0].put(KEY, "state", b"one", "leased")
        fleet.run(1.99)
        fleet.nodes[2].stop()
        fleet.run(5.0)
        self.assertEqual(told, [[b"one"]])

    def test_failing_subscriber(self) -> None:
        """An exception in a subscriber is logged, and the other subscribers are notified."""
        fleet = self.fleet(2)
        fleet.nodes[1].watch(KEY, lambda records: [][0])
        told = self.watched(fleet.nodes[1])
        fleet.nodes[0].put(KEY, "state", b"one")
        fleet.run(1.0)
        self.assertEqual(told, [[b"one"]])
        self.assertEqual(len(self.flushLoggedErrors(IndexError)), 1)

    def test_push_by_a_stranger(self) -> None:
        """A node ignores invalid pushes, and pushes from replicas at which it has no subscription."""
        fleet = self.fleet(3)
        told = self.watched(fleet.nodes[2])
        fleet.run(0.5)
        pusher, target = fleet.nodes[0].endpoint, fleet.nodes[2].contact
        genuine = Record(KEY, "x", fleet.nodes[0].identity.public, 9, "team", 1.0, b"x").sign(fleet.identity(0))
        forged = Record(KEY, "x", fleet.nodes[1].identity.public, 9, "team", 1.0, b"x", bytes(64))
        bad: list[list[list[Any]]] = [
            [[forged.pack()], []],
            [[5, None, []], [5, [], [1, 2], [[], "x"], [b"", "x", 1]]],
        ]
        for records, gone in bad:
            self.done(fleet, pusher.ask(target, "push", KEY, 1, records, gone, changes=True), 0.5)
        self.assertEqual(told, [])
        fleet.nodes[2]._subscriber._watches[0].requested.clear()
        self.done(fleet, pusher.ask(target, "push", KEY, 1, [genuine.pack()], [], changes=True), 0.01)
        self.assertEqual(told, [])

    def test_rough_weather(self) -> None:
        """At 30 % loss each value arrives at all nodes, and leased records of running nodes stay visible.

        The leases last 1 s and are renewed three times per second. One in several hundred still expires, and is visible
        again within 2 s.
        """
        for seed in range(3):
            fleet = self.fleet(4, seed, ROUGH)
            fleet.run(8.0)
            tellings = [self.watched(node) for node in fleet.nodes]
            for node in fleet.nodes:
                stored = node.put(KEY, "state", node.identity.node_id[:2], "leased")
                stored.addErrback(lambda failure: failure.trap(NoAnswer))
            fleet.run(15.0)
            everybody = sorted(node.identity.node_id[:2] for node in fleet.nodes)
            for _ in range(20):
                if all(len(told[-1]) == 4 for told in tellings):
                    break
                fleet.run(0.1)
            for told in tellings:
                self.assertEqual(sorted(told[-1], key=repr), sorted(everybody, key=repr), seed)
            fleet.nodes[1].stop_silently()
            fleet.run(8.0)
            others = [told for place, told in enumerate(tellings) if place != 1]
            for told in others:
                self.assertNotIn(fleet.nodes[1].identity.node_id[:2], told[-1], seed)
            for _ in range(20):
                if all(len(told[-1]) == 3 for told in others):
                    break
                fleet.run(0.1)
            self.assertEqual({len(told[-1]) for told in others}, {3}, seed)


class RpcTests(NodeCase):
    def test_decorated_function_is_called(self) -> None:
        """A decorated function answers calls; its arguments are checked, and its rejections contain a code."""
        fleet = self.fleet(2)
        server, client = fleet.nodes
        counted: list[int] = []

        @server.rpc("divide")
        def divide(peer: Contact, a: int, b: int) -> float:
            if b == 0:
                raise Refused("nothing can be divided by 0", "zero")
            return a / b

        @server.rpc("count", changes=True)
        def count(peer: Contact, step: int) -> int:
            counted.append(step)
            return sum(counted)

        self.assertEqual(self.done(fleet, client.call(server.contact, "divide", 7, 2), 0.5), 3.5)
        self.assertEqual(self.done(fleet, client.call(server.contact, "count", 2, changes=True), 0.5), 2)
        zero, text, unknown = (
            client.call(server.contact, "divide", 1, 0),
            client.call(server.contact, "divide", "1", 2),
            client.call(server.contact, "multiply", 1, 2),
        )
        fleet.run(0.5)
        self.assertEqual(self.failureResultOf(zero, Refused).value.code, "zero")
        self.assertIn("argument 1 must be int", str(self.failureResultOf(text, Refused).value))
        self.failureResultOf(unknown, Refused)
        self.assertEqual(divide(client.contact, 1, 2), 0.5)


class KeepTests(NodeCase):
    def setUp(self) -> None:
        super().setUp()
        self.world = self.fleet(14, seed=4)
        key_id = int.from_bytes(KEY)
        self.order = sorted(self.world.nodes, key=lambda n: int.from_bytes(n.identity.node_id) ^ key_id)
        self.page, self.dog = self.order[-1], self.order[-2]

    def test_copies_follow_what_is_seen(self) -> None:
        """A node that watches a key with ``keep`` has the key's records in its store, even if it is not a holder."""
        store = self.page.store
        self.dog.put(KEY, "state", b"here", "leased")
        self.world.run(1.0)
        self.assertEqual(store.get(KEY), [])
        watch = self.page.watch(KEY, lambda records: None, keep=True)
        self.world.run(10.0)
        self.assertEqual([r.value for r in store.get(KEY)], [b"here"])
        self.dog.put(KEY, "state", b"there", "leased")
        self.world.run(0.5)
        self.assertEqual([r.value for r in store.get(KEY)], [b"there"])
        self.dog.stop_silently()
        self.world.run(1.0 + 3 * SWEEP_INTERVAL_S)
        self.assertEqual(store.get(KEY), [])
        self.order[0].put(KEY, "task", b"do it")
        self.world.run(1.0)
        self.assertEqual([r.value for r in store.get(KEY)], [b"do it"])
        watch.stop()
        self.assertEqual(store.get(KEY), [])

    def test_copies_are_nobodys_opinion(self) -> None:
        """Watched copies are not returned to other nodes, and are removed when the node stops."""
        self.dog.put(KEY, "state", b"here", "leased")
        self.page.watch(KEY, lambda records: None, keep=True)
        self.world.run(3.0)
        self.assertEqual(len(self.page.store.get(KEY)), 1)
        asked = self.order[0].endpoint.ask(self.page.contact, "find_value", KEY, None)
        self.assertEqual(self.done(self.world, asked, 1.0)[:2], [[], None])
        self.page.stop_silently()
        self.assertEqual(self.page.store.get(KEY), [])

    def test_copy_that_comes_to_be_held(self) -> None:
        """If a watched copy is later stored as a replica, it is treated like any other record; its lease can end."""
        self.dog.put(KEY, "state", b"here", "leased")
        self.page.watch(KEY, lambda records: None, keep=True)
        self.world.run(3.0)
        record = self.page.store.get(KEY)[0]
        self.assertTrue(self.page.replica.store_locally(record).is_stored)
        self.assertEqual(self.page.replica.get_held(KEY), [record])
        self.dog.stop_silently()
        self.world.run(2.0)
        self.assertEqual(self.page.store.get(KEY), [])


class LargeFleetTests(NodeCase):
    def test_more_nodes_than_replicas(self) -> None:
        """In a team of 20 all nodes find each value, and leased records expire only with their owners."""
        fleet = self.fleet(20, seed=3, weather=LinkConditions(delay_s=0.002))
        for place in (0, 7, 13, 19):
            fleet.nodes[place].put(KEY, "state", bytes([place]), "leased")
            fleet.nodes[place].put(hash_key(f"task {place}"), "task", b"do it")
        told = self.watched(fleet.nodes[5])
        fleet.run(25.0)
        self.assertEqual(sorted(told[-1], key=repr), sorted((bytes([p]) for p in (0, 7, 13, 19)), key=repr))
        settled = len(told)
        fleet.run(25.0)
        self.assertEqual(len(told), settled, "the team flickers")
        fleet.nodes[13].stop_silently()
        fleet.run(1.0 + 3 * SWEEP_INTERVAL_S)
        self.assertEqual(len(told[-1]), 3)
        for place in range(20):
            if place != 13:
                self.assertEqual(self.values(fleet, place, hash_key("task 13")), [b"do it"])

    def test_no_chatter_about_leases(self) -> None:
        """If all records are at their holders, no replica reports missing leases."""
        fleet = self.fleet(14, seed=5)
        complaints: list[str] = []
        for node in fleet.nodes:
            node.put(KEY, "state", b"here", "leased")
            node.put(hash_key(node.contact.address.__str__()), "own", b"here", "leased")
        fleet.run(15.0)
        for node in fleet.nodes:
            node.endpoint.expose("missing", lambda peer, marks: complaints.append(str(peer.address)))
        fleet.run(10.0)
        self.assertEqual(complaints, [])

    def test_the_next_in_line_inherits(self) -> None:
        """When a holder leaves, the next closest node receives its records immediately."""
        fleet = self.fleet(14, seed=7)
        self.done(fleet, fleet.nodes[13].put(KEY, "task", b"do it"))
        fleet.nodes[13].stop_silently()
        fleet.run(25.0)
        order = select_closest([node.contact for node in fleet.nodes[:13]], KEY, 13)
        leaver, heir = (fleet.nodes[order[n].address.port - 7000] for n in (1, K))
        self.assertEqual(heir.store.get(KEY), [])
        leaver.stop()
        fleet.run(0.5)
        self.assertEqual([r.value for r in heir.store.get(KEY)], [b"do it"])

    def test_former_replicas_do_not_count(self) -> None:
        """When new nodes become holders of a key, watchers of the key discard the reports of the former holders."""
        fleet = self.fleet(10, seed=8)
        self.done(fleet, fleet.nodes[0].put(KEY, "task", b"do it"))
        told = self.watched(fleet.nodes[0])
        fleet.run(3.0)
        for _ in range(10):
            fleet.add()
        fleet.run(5.0)
        holders = {c.node_id for c in select_closest([node.contact for node in fleet.nodes], KEY, K)}
        replicas = set(fleet.nodes[0]._subscriber._watches[0].view.replicas())
        self.assertLessEqual(replicas - {fleet.nodes[0].identity.node_id}, holders)
        self.assertEqual(told, [[b"do it"]])


class JoinTests(NodeCase):
    def test_bootstrap_comes_later(self) -> None:
        """A node repeats its join until its bootstrap node is available."""
        fleet = self.fleet(1)
        fleet.nodes[0].stop_silently()
        node = fleet.make_node(1)
        fleet.nodes.append(node)
        joined = fleet.start_node(node, [fleet.address(0)])
        fleet.run(20.0)
        self.assertNoResult(joined)
        fleet.restart(0)
        fleet.run(8.0)
        self.successResultOf(joined)
        self.assertEqual(len(fleet.nodes[0].overlay.table), 1)

    def test_known_to_oneself_only(self) -> None:
        """A bootstrap node that knows only its own address becomes the first node of its network."""
        fleet = self.fleet(1)
        node = fleet.make_node(1)
        fleet.nodes.append(node)
        self.done(fleet, fleet.start_node(node, [fleet.address(1)]))

    def test_stopped_while_joining(self) -> None:
        """A node that stops while it joins leaves no state."""
        for seconds in (0.1, 3.0):
            fleet = self.fleet(1)
            node = fleet.make_node(1)
            fleet.nodes.append(node)
            joined = fleet.start_node(node, [fleet.address(9)])
            fleet.run(seconds)
            self.assertNoResult(joined)
            node.stop()
            self.failureResultOf(joined, NotRunning)

    def test_rejoin_through_remembered_contacts(self) -> None:
        """A restarted node rejoins through stored contacts if its bootstrap node has failed."""
        fleet = self.fleet(4)
        fleet.run(31.0)
        fleet.nodes[3].stop_silently()
        fleet.nodes[0].stop_silently()
        fleet.run(1.0)
        node = fleet.restart(3)
        fleet.run(3.0)
        self.assertEqual(
            {c.address for c in node.overlay.table.list_contacts()} >= {fleet.address(1), fleet.address(2)}, True
        )

    def test_first_node_does_not_wait_for_the_dead(self) -> None:
        """If all stored contacts of a bootstrap node have failed, it starts without them."""
        fleet = self.fleet(2)
        fleet.nodes[0].stop()
        fleet.nodes[1].stop_silently()
        fleet.nodes[0] = fleet.make_node(0)
        self.done(fleet, fleet.start_node(fleet.nodes[0], []), 4.0)

    def test_rotten_memory(self) -> None:
        """A node starts with any stored contacts, including invalid ones."""
        for rotten in (b"", b"\xc1", msgpack.packb(5), msgpack.packb([5, [b"x", "y", 1]]), b"\x91" * 2000):
            fleet = self.fleet(1)
            fleet.nodes[0].stop()
            fleet.stores[0].set_note(CONTACTS_NOTE, rotten)
            node = fleet.make_node(0)
            fleet.nodes[0] = node
            self.done(fleet, fleet.start_node(node, []))


class WireTests(NodeCase):
    METHODS = ("store", "find_value", "watch", "alive", "let_go", "goodbye!", "push", "missing", "find_node", "ping")

    def test_malformed_questions_change_nothing(self) -> None:
        """Invalid arguments to any method are rejected, without a log entry and without a change."""
        fleet = self.fleet(3)
        self.done(fleet, fleet.nodes[0].put(KEY, "state", b"one"))
        rng = random.Random(5)
        good = fleet.stores[0].get(KEY)[0].pack()
        pieces: list[Any] = [None, 5, -1.5, "x", b"x", KEY, [], [5], [[]], {}]
        pieces += [[good[:7]], [good, 5], [None, "x"], [1, 2]]
        before = [store.records() for store in fleet.stores.values()]
        for method in self.METHODS:
            for _ in range(25):
                arguments = [rng.choice(pieces) for _ in range(rng.randrange(4))]
                asked = fleet.nodes[2].endpoint.ask(fleet.nodes[0].contact, method, *arguments, changes=True)
                asked.addErrback(lambda failure: failure.trap(Refused))
                fleet.run(0.02)
        fleet.run(2.0)
        self.assertEqual(self.flushLoggedErrors(), [])
        self.assertEqual([store.records() for store in fleet.stores.values()], before)

    def test_half_a_message_is_none(self) -> None:
        """If one of several records is invalid, none of them is stored."""
        fleet = self.fleet(2)
        owner = fleet.nodes[1].identity
        genuine = Record(KEY, "y", owner.public, 9, "team", 60.0, b"y").sign(owner)
        asked = fleet.nodes[1].endpoint.ask(fleet.nodes[0].contact, "store", [genuine.pack(), 5], changes=True)
        fleet.run(1.0)
        self.failureResultOf(asked, Refused)
        self.assertEqual(fleet.stores[0].get(KEY), [])

    def test_lying_replica(self) -> None:
        """A replica that sends invalid replies does not affect the results of other replicas."""
        fleet = self.fleet(4)
        answers: list[Any] = [None, 5, [], [[]], [[], []], [[5], None], [2**63 - 1], [True], [[None] * 3, [b"", ""]]]
        for answer in answers:
            for method in ("store", "find_value", "watch", "find_node", "ping"):
                fleet.nodes[3].endpoint.expose(method, lambda peer, *_, answer=answer: answer)
            self.done(fleet, fleet.nodes[0].put(KEY, "state", repr(answer).encode()))
            self.assertEqual(self.values(fleet, 1), [repr(answer).encode()])
        self.assertEqual(self.flushLoggedErrors(), [])
