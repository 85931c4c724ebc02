"""Tests of the workloads of a simulated team: their figures, and the violations that they detect."""

from __future__ import annotations

import random
from typing import Any

from twisted.internet.defer import Deferred, succeed
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.lease.acceptor import LeaseAcceptor
from middleware.entangled.clock import HeapClock
from middleware.entangled.kademlia.distance import distance
from middleware.entangled.node import EntangledNode
from middleware.entangled.quorum.register import Reply, ReplyKind
from middleware.entangled.record import Record
from sim.team.load.catalogue import LOADS
from sim.team.load.client_workload import NodeIdIndex, Pacer
from sim.team.load.values import NAME
from sim.team.metric import Metric
from sim.team.run import Outcome, Run
from sim.team.scenario import parse_scenario


def played(text: str, seed: int = 1) -> tuple[Outcome, dict[str, Metric]]:
    """Run a scenario; return the outcome and its figures by name."""
    settings = {name: kind.settings for name, kind in LOADS.items()}
    outcome = Run(parse_scenario(text, "test", "test", settings), seed, LOADS).run()
    return outcome, {metric.name: metric for metric in outcome.metrics}


class NodeIdIndexTests(SynchronousTestCase):
    def test_closest(self) -> None:
        """While nodes join and end at random, ``find_closest`` gives the same result as a search of all nodes."""
        rng, census, living = random.Random(1), NodeIdIndex(), set()
        for _ in range(300):
            born = rng.randbytes(20)
            census.add(born)
            living.add(born)
            if rng.random() < 0.4:
                gone = rng.choice(sorted(living))
                census.remove(gone)
                living.remove(gone)
            key, without = rng.randbytes(20), rng.choice([*sorted(living), b"\0" * 20])
            if rng.random() < 0.3:
                key = rng.choice([*sorted(living), key])
            wanted = sorted(living - {without}, key=lambda each: distance(each, key))[:8]
            self.assertEqual(census.find_closest(key, 8, without), wanted)
        self.assertEqual(len(census), len(living))


class PacerTests(SynchronousTestCase):
    def test_due(self) -> None:
        """Operations become due at the given rate, up to the total number, whatever the interval of the polls."""
        clock = HeapClock()
        pace = Pacer(clock, 2.5, 12)
        due = [pace.take_due()]
        for seconds in (0.5, 0.5, 1.0, 2.0, 10.0):
            clock.advance(seconds)
            due.append(pace.take_due())
        self.assertEqual(due, [0, 1, 1, 3, 5, 2])
        self.assertTrue(pace.is_over)


RECORDS = "nodes = 5\nseconds = 10.0\nrepair = 5.0\n[load.records]\nrate = 6.0\nkeys = 2\n"
LOOKUPS = 'nodes = 12\nseconds = 5.0\n[link]\nkind = "internet"\n[load.lookups]\nrate = 20.0\nexact = 20\n'
VALUES = 'nodes = 12\nseconds = 50.0\n[link]\nkind = "lan"\n[load.values]\nrate = 0.5\ncount = 1\ndeaths = "quorum"\n'
HOLDERS = "nodes = 12\nseconds = 10.0\n[load.values]\nrate = 2.0\ncount = 10\n"
WATCHES = 'nodes = 8\nseconds = 20.0\n[link]\nkind = "lan"\n[load.watches]\nkeys = 2\nwatchers = 4\n'
AUCTIONS = 'seconds = 14.0\n[link]\nkind = "wifi"\n[load.auctions]\ncount = 2\nevery = 5.0\n'
DIRECTORY = 'nodes = 12\nkind = "swarm"\nseconds = 8.0\n[load.directory]\nreaders = 2\nevery = 3.0\n'
TAKEOVERS = 'nodes = 12\nseconds = 60.0\n[link]\nkind = "wifi"\n[load.takeovers]\ncount = 8\nrate = 0.2\n'
TASKS = 'nodes = 16\nseconds = 8.0\n[link]\nkind = "wifi"\nloss = 0.1\n[load.tasks]\ncount = 30\n'
TRAFFIC = "nodes = 12\nseconds = 20.0\n[load.traffic]\n"
Bounds = dict[str, tuple[float, float]]


class QuietTests(SynchronousTestCase):
    """In a run without faults the workloads find no violation and measure the expected values."""

    def check(self, text: str, bounds: Bounds, **counts: int) -> None:
        """Run a scenario, and check that it has no violation.

        Each figure in ``bounds`` must be within its bounds, and each figure in ``counts`` must have that number of
        samples.
        """
        outcome, figures = played(text)
        self.assertEqual(outcome.violations, [])
        for name, (low, high) in bounds.items():
            value = figures[name].value
            assert value is not None
            self.assertTrue(low <= value <= high, (name, value))
        for name, count in counts.items():
            self.assertEqual(figures[name.replace("__", ".")].n, count, name)

    def test_records(self) -> None:
        """Every write is acknowledged and every value is read."""
        self.check(RECORDS, {"records.acknowledged": (1.0, 1.0), "records.read": (1.0, 1.0)})

    def test_lookups(self) -> None:
        """Every lookup finds its node in time, and finds the closest nodes of every key in the right order."""
        bounds: Bounds = {"lookups.reached.p50": (0.05, 0.9), "lookups.seconds.p50": (0.05, 1.0)}
        bounds |= {"lookups.success": (1.0, 1.0), "lookups.exact": (1.0, 1.0)}
        self.check(LOOKUPS, bounds, lookups__success=90, lookups__exact=20)

    def test_values(self) -> None:
        """A value survives the end of all but one of the nodes that acknowledged it; a reader finds every holder."""
        bounds: Bounds = {"values.read": (1.0, 1.0), "values.lost": (0.0, 0.0), "values.killed": (4.0, 8.0)}
        self.check(VALUES, bounds, values__read=1)
        bounds = {"values.holders_found": (1.0, 1.0), "values.copies": (8.0, 8.0), "values.lost": (0.0, 0.0)}
        self.check(HOLDERS, bounds, values__lost=10)

    def test_watches(self) -> None:
        """Every watcher receives every change within a second."""
        self.check(WATCHES, {"watches.heard": (1.0, 1.0), "watches.seconds.max": (0.0, 1.0)})

    def test_auctions(self) -> None:
        """In small and large teams all bidders choose the nearest agent soon after the waiting period."""
        bounds: Bounds = {"auctions.right": (1.0, 1.0), "auctions.last": (0.0, 0.6), "auctions.messages": (1.0, 10.0)}
        for nodes in (3, 40):
            self.check(f"nodes = {nodes}\n{AUCTIONS}", bounds, auctions__agree__p50=2 * nodes)

    def test_directory(self) -> None:
        """Each device is stored, each reader finds all devices, and the load of the busiest node is measured."""
        bounds: Bounds = {"directory.held.mean": (1.0, 12.0), "directory.busiest": (1 / 12, 1.0)}
        self.check(DIRECTORY, {**bounds, "directory.devices": (12.0, 12.0), "directory.listed_whole": (1.0, 1.0)})

    def test_takeovers(self) -> None:
        """When the holder of a lease fails, another node gets the lease within two seconds.

        At no time do two nodes hold the lease.
        """
        self.check(TAKEOVERS, {"takeovers.seconds.max": (0.5, 2.0)}, takeovers__seconds__max=8)

    def test_tasks(self) -> None:
        """Each of many concurrent tasks has one holder, which is the nearest agent, even if datagrams are lost."""
        self.check(TASKS, {"tasks.held_once": (1.0, 1.0), "tasks.by_the_nearest": (1.0, 1.0)}, tasks__held_once=30)

    def test_traffic(self) -> None:
        """In a team of twelve without faults each node knows all others and sends at most ten datagrams per second."""
        bounds: Bounds = {"traffic.datagrams": (0.5, 10.0), "traffic.bytes": (15.0, 3000.0)}
        self.check(TRAFFIC, {**bounds, "traffic.contacts": (11.0, 11.0)})


class WrongTests(SynchronousTestCase):
    """The workloads detect defects."""

    def test_what_is_not_kept(self) -> None:
        """A node that acknowledges writes without storing them violates invariant D1, and watchers miss the change."""
        self.patch(EntangledNode, "put", lambda node, *what: succeed(5))
        outcome, _ = played(RECORDS)
        self.assertEqual({line[:3] for line in outcome.violations}, {"D1:"})
        _, figures = played(WATCHES)
        self.assertEqual(figures["watches.heard"].value, 0.0)

    def test_what_is_old(self) -> None:
        """A reader that always gets the first value of a slot violates invariant D2."""
        get, first = EntangledNode.get, dict[Any, Record]()

        def stale(node: EntangledNode, key: bytes, *concern: Any) -> Deferred[list[Record]]:
            return get(node, key, *concern).addCallback(lambda found: [first.setdefault(r.slot, r) for r in found])

        self.patch(EntangledNode, "get", stale)
        outcome, _ = played(RECORDS)
        self.assertIn("D2:", {line[:3] for line in outcome.violations})

    def test_wrong_and_late_lookups(self) -> None:
        """A lookup beyond its time limit is late; a lookup that misses the closest node is wrong and not exact."""
        _, figures = played(LOOKUPS + "limit = 0.1\n")
        self.assertEqual((figures["lookups.success"].value, figures["lookups.late"].value), (0.0, 90.0))
        find = EntangledNode.find_node

        def without_first(node: EntangledNode, target: bytes) -> Deferred[Any]:
            return find(node, target).addCallback(lambda found: found[1:])

        self.patch(EntangledNode, "find_node", without_first)
        outcome, figures = played(LOOKUPS)
        self.assertEqual((figures["lookups.success"].value, figures["lookups.wrong"].value), (0.0, 90.0))
        self.assertEqual(figures["lookups.exact"].value, 0.0)
        self.assertIn("D6: node", outcome.violations[0])
        self.assertEqual(len([line for line in outcome.violations if line.startswith("D6")]), 20)

    def test_lost_values(self) -> None:
        """A value that no node returns is lost: this is a violation, and ``values.lost`` misses its target."""
        get = EntangledNode.get

        def nothing(node: EntangledNode, key: bytes, concern: Any = "majority") -> Deferred[list[Record]]:
            return get(node, key, concern).addCallback(lambda rs: [r for r in rs if r.name != NAME])

        self.patch(EntangledNode, "get", nothing)
        outcome, figures = played(VALUES + "patience = 4.0\n")
        self.assertEqual(figures["values.lost"].value, 1.0)
        self.assertIs(figures["values.lost"].holds, False)
        self.assertTrue(any("is lost after" in line for line in outcome.violations))

    def test_two_holders(self) -> None:
        """Acceptors that grant every request give a lease to two holders, which violates invariant E2."""
        self.patch(
            LeaseAcceptor, "prepare", lambda acceptor, task, number, ballot, *_: Reply(ReplyKind.GRANTED, ballot)
        )
        self.patch(
            LeaseAcceptor,
            "lease",
            lambda acceptor, task, number, ballot, token, *_: Reply(ReplyKind.GRANTED, ballot, token),
        )
        outcome, _ = played(TASKS)
        self.assertTrue(any(line.startswith("E2") for line in outcome.violations), outcome.violations)


class RepeatTests(SynchronousTestCase):
    def test_same_seed_same_hash(self) -> None:
        """A run with every workload gives the same digest twice, and a different digest with a different seed."""
        text = 'nodes = 10\nseconds = 6.0\n[link]\nkind = "wifi"\nloss = 0.05\n'
        few = {"tasks": "count = 10\n", "values": "count = 5\n", "takeovers": "rate = 0.5\n"}
        text += "".join(f"[load.{name}]\n{few.get(name, '')}" for name in sorted(LOADS))
        one, same, other = (played(text, seed)[0].digest for seed in (1, 1, 2))
        self.assertEqual(one, same)
        self.assertNotEqual(one, other)
