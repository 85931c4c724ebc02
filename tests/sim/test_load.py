"""The workloads of a team: what they measure, and that they see what is wrong."""

from __future__ import annotations

import random
from typing import Any

from twisted.internet.defer import Deferred, succeed
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.lease.acceptor import LeaseAcceptor
from middleware.entangled.clock import HeapClock
from middleware.entangled.kademlia.distance import distance
from middleware.entangled.node import EntangledNode
from middleware.entangled.quorum.ballot import Ballot
from middleware.entangled.quorum.register import Kind, Reply
from middleware.entangled.record import Record
from sim.team.figure import Figure
from sim.team.load.catalogue import LOADS
from sim.team.load.residents import Census, Pace
from sim.team.load.values import NAME
from sim.team.run import Outcome, Run
from sim.team.scenario import scenario_of


def played(text: str, seed: int = 1) -> tuple[Outcome, dict[str, Figure]]:
    """The outcome of a scenario, and its figures by name."""
    settings = {name: kind.settings for name, kind in LOADS.items()}
    outcome = Run(scenario_of(text, "test", "test", settings), seed, LOADS).go()
    return outcome, {figure.name: figure for figure in outcome.figures}


class CensusTests(SynchronousTestCase):
    def test_closest(self) -> None:
        """Whoever lives, dies and asks: those closest are the same as by looking at everybody."""
        dice, census, living = random.Random(1), Census(), set()
        for _ in range(300):
            born = dice.randbytes(20)
            census.born(born)
            living.add(born)
            if dice.random() < 0.4:
                gone = dice.choice(sorted(living))
                census.died(gone)
                living.remove(gone)
            key, without = dice.randbytes(20), dice.choice([*sorted(living), b"\0" * 20])
            if dice.random() < 0.3:
                key = dice.choice([*sorted(living), key])
            wanted = sorted(living - {without}, key=lambda each: distance(each, key))[:8]
            self.assertEqual(census.closest(key, 8, without), wanted)
        self.assertEqual(len(census), len(living))


class PaceTests(SynchronousTestCase):
    def test_due(self) -> None:
        """So many a second are due, however rarely it is asked, and none beyond the last."""
        clock = HeapClock()
        pace = Pace(clock, 2.5, 12)
        due = [pace.due()]
        for seconds in (0.5, 0.5, 1.0, 2.0, 10.0):
            clock.advance(seconds)
            due.append(pace.due())
        self.assertEqual(due, [0, 1, 1, 3, 5, 2])
        self.assertTrue(pace.is_over)


class RecordTests(SynchronousTestCase):
    TEXT = "nodes = 5\nseconds = 10.0\nrepair = 5.0\n[load.records]\nrate = 6.0\nkeys = 2\n"

    def test_quiet(self) -> None:
        """In a quiet team everything is answered, and the checker finds nothing."""
        outcome, figures = played(self.TEXT)
        self.assertEqual(outcome.violations, [])
        self.assertEqual((figures["records.acknowledged"].value, figures["records.read"].value), (1.0, 1.0))
        self.assertGreater(figures["records.read"].n, 20)

    def test_what_is_not_kept_shows(self) -> None:
        """A node that acknowledges what it does not store breaks D1, as the checker of the history sees it."""
        self.patch(EntangledNode, "put", lambda node, *what: succeed(5))
        outcome, _ = played(self.TEXT)
        self.assertTrue(outcome.violations)
        self.assertEqual({line[:3] for line in outcome.violations}, {"D1:"})

    def test_what_is_old_shows(self) -> None:
        """A reader that is shown the first value of a slot for ever is shown what is not fresh (D2)."""
        get, first = EntangledNode.get, dict[Any, Record]()

        def stale(node: EntangledNode, key: bytes, *concern: Any) -> Deferred[list[Record]]:
            return get(node, key, *concern).addCallback(lambda found: [first.setdefault(r.slot, r) for r in found])

        self.patch(EntangledNode, "get", stale)
        outcome, _ = played(self.TEXT)
        self.assertIn("D2:", {line[:3] for line in outcome.violations})


class LookupTests(SynchronousTestCase):
    TEXT = 'nodes = 12\nseconds = 5.0\n[link]\nkind = "internet"\n[load.lookups]\nrate = 20.0\nexact = 20\n'

    def test_quiet(self) -> None:
        """In a quiet team every lookup finds its node in time, and every key its closest nodes, in their order."""
        outcome, figures = played(self.TEXT)
        self.assertEqual(outcome.violations, [])
        self.assertEqual((figures["lookups.success"].value, figures["lookups.success"].n), (1.0, 90))
        self.assertEqual((figures["lookups.exact"].value, figures["lookups.exact"].n), (1.0, 20))
        whole, reached = figures["lookups.seconds.p50"].value, figures["lookups.reached.p50"].value
        assert whole is not None and reached is not None
        self.assertTrue(0.05 < reached < whole < 1.0, (reached, whole))

    def test_wrong_answers_show(self) -> None:
        """A lookup that leaves the closest node out is counted as wrong, and is told as not exact."""
        find = EntangledNode.find_node

        def without_first(node: EntangledNode, target: bytes) -> Deferred[Any]:
            return find(node, target).addCallback(lambda found: found[1:])

        self.patch(EntangledNode, "find_node", without_first)
        outcome, figures = played(self.TEXT)
        self.assertEqual((figures["lookups.success"].value, figures["lookups.wrong"].value), (0.0, 90.0))
        self.assertEqual(figures["lookups.exact"].value, 0.0)
        self.assertIn("D6: node", outcome.violations[0])
        self.assertEqual(len([line for line in outcome.violations if line.startswith("D6")]), 20)

    def test_late_answers_show(self) -> None:
        """A lookup that takes longer than its limit has failed, though it finds what it looked for."""
        _, figures = played(self.TEXT + "limit = 0.1\n")
        self.assertEqual((figures["lookups.success"].value, figures["lookups.late"].value), (0.0, 90.0))


class ValueTests(SynchronousTestCase):
    TEXT = 'nodes = 12\nseconds = 50.0\n[link]\nkind = "lan"\n[load.values]\nrate = 0.5\ncount = 1\ndeaths = "quorum"\n'

    def test_survive_a_minority(self) -> None:
        """A value outlives all but one of those that acknowledged it, whoever reads it."""
        outcome, figures = played(self.TEXT)
        self.assertEqual(outcome.violations, [])
        self.assertEqual((figures["values.read"].value, figures["values.read"].n), (1.0, 1))
        self.assertEqual(figures["values.lost"].value, 0.0)
        killed = figures["values.killed"].value
        assert killed is not None
        self.assertGreaterEqual(killed, 4.0)

    def test_holders_are_found(self) -> None:
        """In quiet a reader finds every holder of every value."""
        outcome, figures = played("nodes = 12\nseconds = 10.0\n[load.values]\nrate = 2.0\ncount = 10\n")
        self.assertEqual(outcome.violations, [])
        self.assertEqual((figures["values.holders_found"].value, figures["values.copies"].value), (1.0, 8.0))
        self.assertEqual((figures["values.lost"].value, figures["values.lost"].n), (0.0, 10))

    def test_lost_values_show(self) -> None:
        """Where nobody answers with the value, that is told at once as a violation, and in the end as a loss."""
        get = EntangledNode.get

        def nothing(node: EntangledNode, key: bytes, concern: Any = "majority") -> Deferred[list[Record]]:
            return get(node, key, concern).addCallback(lambda rs: [r for r in rs if r.name != NAME])

        self.patch(EntangledNode, "get", nothing)
        outcome, figures = played(self.TEXT + "patience = 4.0\n")
        self.assertEqual(figures["values.lost"].value, 1.0)
        self.assertIs(figures["values.lost"].holds, False)
        self.assertTrue(any("is lost after" in line for line in outcome.violations))


class WatchTests(SynchronousTestCase):
    TEXT = 'nodes = 8\nseconds = 20.0\n[link]\nkind = "lan"\n[load.watches]\nkeys = 2\nwatchers = 4\n'

    def test_all_hear(self) -> None:
        """Every follower hears of every change, well within a second."""
        _, figures = played(self.TEXT)
        heard = figures["watches.heard"]
        self.assertEqual(heard.value, 1.0)
        self.assertGreater(heard.n, 40)
        slowest = figures["watches.seconds.max"].value
        assert slowest is not None
        self.assertLess(slowest, 1.0)

    def test_unheard_changes_show(self) -> None:
        """A change that is not stored anywhere is heard by nobody, and each follower that missed it is counted."""
        self.patch(EntangledNode, "put", lambda *arguments: succeed(0))
        _, figures = played(self.TEXT)
        self.assertEqual(figures["watches.heard"].value, 0.0)


class AuctionTests(SynchronousTestCase):
    def test_all_agree(self) -> None:
        """Everybody that bids takes the nearest for who is to act, soon after the waiting period, with few messages."""
        for nodes in (3, 40):
            text = f'nodes = {nodes}\nseconds = 14.0\n[link]\nkind = "wifi"\n[load.auctions]\ncount = 2\nevery = 5.0\n'
            outcome, figures = played(text)
            self.assertEqual(outcome.violations, [])
            self.assertEqual((figures["auctions.right"].value, figures["auctions.agree.p50"].n), (1.0, 2 * nodes))
            last, messages = figures["auctions.last"].value, figures["auctions.messages"].value
            assert last is not None and messages is not None
            self.assertLess(last, 0.6)
            self.assertTrue(1.0 < messages < 10.0, messages)


class DirectoryTests(SynchronousTestCase):
    def test_devices(self) -> None:
        """Every device is held somewhere, whoever lists them finds all, and it shows who holds the most."""
        text = 'nodes = 12\nkind = "swarm"\nseconds = 8.0\n[load.directory]\nreaders = 2\nevery = 3.0\n'
        outcome, figures = played(text)
        self.assertEqual(outcome.violations, [])
        self.assertEqual((figures["directory.devices"].value, figures["directory.listed_whole"].value), (12.0, 1.0))
        held, busiest = figures["directory.held.mean"].value, figures["directory.busiest"].value
        assert held is not None and busiest is not None
        self.assertGreaterEqual(held, 1.0)
        self.assertTrue(1 / 12 <= busiest <= 1.0, busiest)


class TakeoverTests(SynchronousTestCase):
    def test_another_one_takes_over(self) -> None:
        """Whenever the holder of a lease dies, another one holds it within two seconds, and never two at once."""
        text = 'nodes = 12\nseconds = 60.0\n[link]\nkind = "wifi"\n[load.takeovers]\ncount = 8\nrate = 0.2\n'
        outcome, figures = played(text)
        self.assertEqual(outcome.violations, [])
        slowest = figures["takeovers.seconds.max"]
        self.assertEqual(slowest.n, 8)
        assert slowest.value is not None
        self.assertTrue(0.5 < slowest.value < 2.0, slowest.value)


class TaskTests(SynchronousTestCase):
    TEXT = 'nodes = 16\nseconds = 8.0\n[link]\nkind = "wifi"\nloss = 0.1\n[load.tasks]\ncount = 30\n'

    def test_one_holder_each(self) -> None:
        """Of many tasks at once each has exactly one holder, also where datagrams are lost."""
        outcome, figures = played(self.TEXT)
        self.assertEqual(outcome.violations, [])
        self.assertEqual((figures["tasks.held_once"].value, figures["tasks.held_once"].n), (1.0, 30))
        self.assertEqual(figures["tasks.by_the_nearest"].value, 1.0)

    def test_two_holders_show(self) -> None:
        """Where a lease is given to whoever asks, it shows that two hold one."""

        def promising(acceptor: LeaseAcceptor, task_id: str, configuration: int, ballot: Ballot, *rest: Any) -> Reply:
            return Reply(Kind.GRANTED, ballot)

        def granting(
            acceptor: LeaseAcceptor, task_id: str, configuration: int, ballot: Ballot, token: int, *rest: Any
        ) -> Reply:
            return Reply(Kind.GRANTED, ballot, token)

        self.patch(LeaseAcceptor, "prepare", promising)
        self.patch(LeaseAcceptor, "lease", granting)
        outcome, _ = played(self.TEXT)
        self.assertTrue(any(line.startswith("E2") for line in outcome.violations), outcome.violations)


class TrafficTests(SynchronousTestCase):
    def test_cost(self) -> None:
        """A quiet team of twelve knows everybody, and sends a few datagrams a second each."""
        _, figures = played("nodes = 12\nseconds = 20.0\n[load.traffic]\n")
        self.assertEqual(figures["traffic.contacts"].value, 11.0)
        datagrams, volume = figures["traffic.datagrams"].value, figures["traffic.bytes"].value
        assert datagrams is not None and volume is not None
        self.assertTrue(0.5 < datagrams < 10.0, datagrams)
        self.assertTrue(30.0 < volume / datagrams < 300.0, volume / datagrams)
        self.assertFalse(figures["traffic.cpu"].is_exact)


class RepeatTests(SynchronousTestCase):
    def test_same_seed_same_hash(self) -> None:
        """A run with every workload has the same hash twice, and another one with another seed."""
        text = 'nodes = 10\nseconds = 6.0\n[link]\nkind = "wifi"\nloss = 0.05\n'
        few = {"tasks": "count = 10\n", "values": "count = 5\n", "takeovers": "rate = 0.5\n"}
        text += "".join(f"[load.{name}]\n{few.get(name, '')}" for name in sorted(LOADS))
        one, same, other = (played(text, seed)[0].digest for seed in (1, 1, 2))
        self.assertEqual(one, same)
        self.assertNotEqual(one, other)
