"""Tests of simulated teams: how nodes join, restart and are replaced, and which events the listeners receive."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.data.memory import MemoryStore
from middleware.node import SwarmNode
from sim.team.link import LinkSettings
from sim.team.scenario import Clocks, Join, Nats, Scenario
from sim.team.team import Team

QUICK = Join(pause=0.2, settle=2.0)


class TeamTests(SynchronousTestCase):
    """Tests of ``Team``."""

    def setUp(self) -> None:
        """Create an empty list of teams."""
        self.teams: list[Team] = []

    def tearDown(self) -> None:
        """Stop all teams."""
        for team in self.teams:
            team.stop()

    def team(self, scenario: Scenario, seed: int = 1) -> Team:
        """Start a team that is stopped at the end of the test."""
        team = Team(scenario, seed)
        self.teams.append(team)
        team.form()
        return team

    def test_all_come_in_whatever_the_way(self) -> None:
        """Nodes join one by one, in batches or simultaneously; in a small team each then knows all others."""
        for join in (QUICK, Join("batches", 0.5, 3, settle=3.0), Join("at once", 0.5, settle=5.0)):
            team = self.team(Scenario(nodes=8, join=join))
            self.assertEqual((team.alive(), sorted(team.get_joined())), (list(range(8)),) * 2, join.how)
            self.assertTrue(team.is_joined())
            known = [len(team.get_entangled(place).overlay.contacts()) for place in team.alive()]
            self.assertEqual(known, [7] * 8, join.how)

    def test_batches_come_in_their_size(self) -> None:
        """The first node starts alone, followed by one batch after each ``pause``."""
        team = Team(Scenario(nodes=6, join=Join("batches", 1.0, 2)), 1)
        self.teams.append(team)
        born: list[tuple[float, int]] = []
        team.event_listeners.append(
            lambda now, event, place, more: born.append((now, place)) if event == "born" else None
        )
        self.assertEqual(team.start_all(), 3.0)
        team.run(3.0)
        self.assertEqual(born, [(0.0, 0), (1.0, 1), (1.0, 2), (2.0, 3), (2.0, 4), (3.0, 5)])

    def test_next_life_is_the_same_node_on_its_disk(self) -> None:
        """A restarted node keeps its identity and its store; listeners are notified of its end and its start."""
        team = self.team(Scenario(nodes=4, join=QUICK))
        lives: list[tuple[str, int]] = []
        team.watch_lives(
            lambda place, node: lives.append(("born", place)), lambda place, node: lives.append(("died", place))
        )
        self.assertEqual(lives, [("born", place) for place in range(4)])
        key = b"k" * 20
        put = team.get_entangled(2).put(key, "x", b"\x01")
        team.run(5.0)
        self.successResultOf(put)
        former = team.get_entangled(2)
        team.kill(2)
        self.assertNotIn(2, team.living)
        self.assertNotIn(2, team.get_joined())
        team.run(1.0)
        team.start(2)
        self.assertEqual([record.name for record in team.get_entangled(2).store.get(key)], ["x"])
        entered = team.when_joined(2)
        self.assertNoResult(entered)
        team.run(2.0)
        self.assertTrue(self.successResultOf(entered))
        self.assertEqual(lives[4:], [("died", 2), ("born", 2)])
        self.assertEqual(team.get_entangled(2).identity, former.identity)

    def test_another_node_may_take_the_place(self) -> None:
        """A replaced node has a different identity and an empty store."""
        team = self.team(Scenario(nodes=4, join=QUICK))
        former = team.identity(3)
        team.leave(3)
        team.replace(3)
        self.assertNotEqual(team.identity(3), former)
        store = team.get_state(3).store
        self.assertIsInstance(store, MemoryStore)
        self.assertEqual(len(store), 0)
        team.start(3)
        team.run(2.0)
        self.assertIn(3, team.get_joined())
        self.assertRaises(ValueError, team.start, 3)
        self.assertRaises(ValueError, team.replace, 3)

    def test_who_ends_before_it_is_in_says_so(self) -> None:
        """``when_joined`` gives False for a node that ends before it has joined, and for a node that is not running."""
        team = self.team(Scenario(nodes=3, join=QUICK))
        place = team.add()
        waiting = team.when_joined(place)
        team.kill(place)
        self.assertFalse(self.successResultOf(waiting))
        self.assertFalse(self.successResultOf(team.when_joined(place)))
        self.assertTrue(self.successResultOf(team.when_joined(0)))
        self.assertEqual(list(team.places), [0, 1, 2, 3])

    def test_still_node_is_lost_and_comes_back(self) -> None:
        """A frozen node is removed from the routing tables; after the thaw it is added again without a restart."""
        team = self.team(Scenario(nodes=4, join=QUICK, clocks=Clocks(drift=0.001)))
        node = team.node(1)
        key = team.identity(1).node_id
        team.freeze(1)
        team.run(20.0)
        self.assertFalse(any(contact.node_id == key for contact in team.get_entangled(0).overlay.contacts()))
        team.thaw(1)
        team.run(10.0)
        self.assertTrue(any(contact.node_id == key for contact in team.get_entangled(0).overlay.contacts()))
        self.assertIs(team.node(1), node)

    def test_freezing_needs_machines(self) -> None:
        """In a scenario without simulated machines, a freeze is rejected; the error contains the missing setting."""
        team = self.team(Scenario(nodes=3, join=QUICK))
        self.assertIn("drift", str(self.assertRaises(ValueError, team.freeze, 1)))

    def test_traffic_is_counted_by_place_over_all_lives(self) -> None:
        """The traffic of all nodes, including their runs before a restart, adds up to that of the switchboard."""
        team = self.team(Scenario(nodes=5, join=QUICK, link=LinkSettings("none")))
        team.kill(4)
        team.start(4)
        team.run(5.0)
        self.assertEqual(sum(team.traffic(place).sent for place in team.places), team.switchboard.counters["sent"])
        received = sum(team.traffic(place).received for place in team.places)
        self.assertEqual(received, team.switchboard.counters["delivered"])
        self.assertGreater(team.traffic(4).received_bytes, 0)

    def test_swarm_nodes_are_there_as_devices(self) -> None:
        """The nodes of a team of swarm nodes see each other as devices."""
        team = self.team(Scenario(nodes=3, kind="swarm", join=QUICK))
        node = team.node(1)
        assert isinstance(node, SwarmNode)
        seen: list[int] = []
        node.watch_devices(lambda records: seen.append(len(records)))
        team.run(5.0)
        self.assertEqual(seen[-1], 3)

    def test_nodes_behind_routers_come_in(self) -> None:
        """Nodes behind a NAT join the network; the first two nodes are never behind a NAT."""
        team = self.team(Scenario(nodes=6, join=QUICK, nat=Nats(0.5, ("port",))))
        behind = [place for place in team.places if team.get_state(place).nat is not None]
        self.assertTrue(behind and not {0, 1} & set(behind))
        self.assertEqual(sorted(team.get_joined()), list(range(6)))

    def test_everything_follows_from_the_seed(self) -> None:
        """Equal scenarios and seeds give equal digests; a different seed gives a different digest."""
        scenario = Scenario(nodes=6, join=Join("at once", 0.1, settle=3.0), link=LinkSettings("wifi", loss=0.1))
        first, second, other = (self.team(scenario, seed).digest() for seed in (7, 7, 8))
        self.assertEqual(first, second)
        self.assertNotEqual(first, other)
