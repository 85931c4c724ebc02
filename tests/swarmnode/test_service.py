"""Tests of ``swarmnode.service``: the start, stop, failure and return of a node."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.errors import PortInUse
from swarmnode.service import NodeService
from tests.swarmnode.team import MemoryTeam


class NodeServiceTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.team = MemoryTeam()
        self.first = self.team.service("a", 7000)
        self.second = self.team.service("b", 7001, is_web=True)
        for service in (self.first, self.second):
            service.startService()
            self.addCleanup(self.end, service)
        self.team.clock.advance(1.0)
        self.devices = self.first.assembly.node.watch_devices(lambda records: None)
        self.team.clock.advance(0.5)

    def end(self, service: NodeService) -> None:
        """Stop the service if it is running."""
        if service.running:
            self.successResultOf(service.stopService())

    def seen(self) -> int:
        """Return the number of devices that the first node knows."""
        return len(self.devices.records)

    def test_service_leaves_in_order(self) -> None:
        """A node that stops leaves the directory before its lease expires, and stops its page."""
        self.assertEqual(self.seen(), 2)
        self.end(self.second)
        self.team.clock.advance(0.1)
        self.assertEqual(self.seen(), 1)
        self.assertFalse(self.team.pages[0].running)

    def test_service_vanishes_without_a_word(self) -> None:
        """A node that loses power stays in the directory until its lease expires, and sends no more datagrams."""
        self.second.vanish()
        self.team.clock.advance(0.3)
        sent = self.team.switchboard.counters["unsent"]
        self.assertEqual(self.seen(), 2)
        self.team.clock.advance(1.2)
        self.assertEqual(self.seen(), 1)
        self.assertEqual(self.team.switchboard.counters["unsent"], sent)

    def test_service_leaves_and_returns(self) -> None:
        """A node that leaves for some time stops its page, and returns with the same identity and a new page."""
        before = self.second.assembly.node
        self.second.leave_for(3.0)
        self.assertFalse(self.team.pages[0].running)
        self.team.clock.advance(2.5)
        self.assertEqual(self.seen(), 1)
        self.team.clock.advance(2.0)
        after = self.second.assembly.node
        self.assertEqual(self.seen(), 2)
        self.assertTrue(after is not before and after.uuid == before.uuid)
        self.assertEqual([page.running for page in self.team.pages], [0, 1])

    def test_second_wish_to_leave_changes_nothing(self) -> None:
        """Two requests to leave that follow each other closely restart the node only once."""
        self.second.leave_for(2.0)
        self.second.leave_for(3.0)
        self.team.clock.advance(2.5)
        back = self.second.assembly.node
        self.team.clock.advance(3.0)
        self.assertIs(self.second.assembly.node, back)
        self.assertEqual(self.seen(), 2)

    def test_stopped_while_away_stays_away(self) -> None:
        """A node that is stopped during its absence does not return."""
        self.second.leave_for(2.0)
        self.end(self.second)
        self.team.clock.advance(5.0)
        self.assertEqual(self.seen(), 1)
        self.assertFalse(self.second.assembly.node.running)

    def test_port_taken_meanwhile_is_tried_again(self) -> None:
        """A node that cannot return because its port is in use tries again until the port is free."""
        self.second.leave_for(1.0)
        squatter = self.team.switchboard.make_network("127.0.0.1", 7001)
        squatter.listen(lambda datagram, source: None)
        self.team.clock.advance(2.0)
        self.assertFalse(self.second.assembly.node.running)
        squatter.close()
        self.team.clock.advance(4.0)
        self.assertEqual(self.seen(), 2)

    def test_port_in_use_flies_at_the_start(self) -> None:
        """A node whose port is in use does not start, and raises ``PortInUse``."""
        third = self.team.service("c", 7001)
        self.assertRaises(PortInUse, third.startService)
