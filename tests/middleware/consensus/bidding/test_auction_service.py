"""Tests of bidding between real nodes: their endpoints send, confirm, accept and reject bids."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from middleware.consensus.bidding import participant
from middleware.consensus.bidding.announcement import AnnouncedReport, Announcement
from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.auction_service import MAX_PARTICIPANTS, Bidding
from middleware.consensus.bidding.bid import Bid
from middleware.consensus.bidding.outgoing_message import MAX_BIDS_PER_MESSAGE
from middleware.consensus.bidding.path_choice import TREE
from middleware.consensus.strategy import Report
from middleware.entangled.errors import Refused
from middleware.entangled.kademlia.distance import select_closest
from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.wire import requester
from middleware.entangled.wire.admission_check import ROLE
from middleware.entangled.wire.message import Failure
from middleware.entangled.wire.method import make_error
from middleware.node import SwarmNode
from middleware.tasks.task import MEMBER, Task, group_key
from tests.fleet import FleetCase, SwarmTeam

WAITING = 0.5


class AuctionCase(FleetCase):
    """A test case with a team and one auction."""

    def prepared(
        self, n: int, seed: int = 1, weather: LinkConditions | None = None, strategy: str = "nearest"
    ) -> SwarmTeam:
        """Return a team in which the council of the task consists of the three nodes nearest to the task's key."""
        fleet = self.swarm(n, seed) if weather is None else self.swarm(n, seed, weather)
        key = group_key("job")
        council = select_closest([node.entangled.contact for node in fleet.nodes], key, 3)
        self.task = Task("job", "find", "Find it", waiting_period=WAITING, council=tuple(council), strategy=strategy)
        self.views: dict[int, list[tuple[Report, ...]]] = {place: [] for place in range(n)}
        return fleet

    def auction(self, **others: Any) -> Auction:
        """Return the auction of the task."""
        return Auction("job", 1, self.task.council, self.task.strategy, WAITING, **others)

    def enter(self, fleet: SwarmTeam, *costs: float) -> list[Bidding]:
        """Let each node bid one of these costs."""
        biddings = []
        for place, cost in enumerate(costs):
            node = fleet.nodes[place]
            bidding = node.start_bidding(self.task, 1, self.views[place].append)
            bidding.report(Report(node.uuid, cost))
            biddings.append(bidding)
        return biddings

    def outsider(self, fleet: SwarmTeam) -> SwarmNode:
        """Return a node that is not a member of the task's council."""
        council = {member.node_id for member in self.task.council}
        return next(node for node in fleet.nodes if node.entangled.identity.node_id not in council)

    def ask(self, fleet: SwarmTeam, sender: SwarmNode, to: SwarmNode, method: str, *arguments: object) -> object:
        """Return the result of a request, its value or its exception."""
        asked = sender.entangled.endpoint.ask(to.entangled.contact, method, *arguments, changes=True)
        asked.addErrback(lambda failure: failure.value)
        return self.done(fleet, asked)


class AuctionServiceTests(AuctionCase):
    """Tests of ``SwarmNode.start_bidding``."""

    def test_all_agree(self) -> None:
        """After the waiting period every bidder has the same reports, in the order of their costs."""
        fleet = self.prepared(4)
        self.enter(fleet, 3.0, 1.0, 2.0)
        fleet.run(WAITING - 0.1)
        self.assertEqual([self.views[place] for place in range(3)], [[], [], []])
        fleet.run(0.6)
        for place in range(3):
            self.assertEqual([r.cost for r in self.views[place][-1]], [1.0, 2.0, 3.0])
            self.assertEqual(self.views[place][-1][0].agent, fleet.nodes[1].uuid)

    def tree(self) -> SwarmTeam:
        """Return a team of twelve in which bids are sent along the tree."""
        fleet = self.prepared(12)
        for node in fleet.nodes:
            node.auction_service._path_choice.path = TREE
            node.auction_service._path_choice.choose = lambda bidders: TREE  # type: ignore[method-assign]
        return fleet

    def assert_agreed(self, fleet: SwarmTeam) -> None:
        """Let all twelve nodes bid, and check that they all choose the last node, which is the nearest."""
        self.enter(fleet, *(float(12 - place) for place in range(12)))
        fleet.run(3.0)
        winners = {self.views[place][-1][0].agent for place in range(12)}
        self.assertEqual(winners, {fleet.nodes[11].uuid})

    def test_tree_of_real_nodes(self) -> None:
        """Bidders agree when their bids are sent along the tree."""
        self.assert_agreed(self.tree())

    def test_more_than_one_carries(self) -> None:
        """A contact accepts a limited number of children; further nodes send to the council, and all bidders agree."""
        fleet = self.tree()
        council = {member.node_id for member in self.task.council}
        outside = [node for node in fleet.nodes if node.entangled.identity.node_id not in council]
        [known] = select_closest([node.entangled.contact for node in outside], group_key("job"), 1)
        refused: list[str] = []

        def noted(failure: Failure) -> Exception:
            refused.append(failure.text)
            return make_error(failure)

        self.patch(participant, "MAX_CHILDREN", 2)
        self.patch(requester, "make_error", noted)
        for node in outside:
            around = replace(node.auction_service._environment, contacts=lambda: [known])
            node.auction_service._environment = around
        self.assert_agreed(fleet)
        self.assertEqual(sum("send their bids to this node" in text for text in refused), len(outside) - 1 - 2)

    def test_withdrawn_and_bid_anew(self) -> None:
        """A withdrawn bid does not count, and a new bid does; an unchanged bid is not sent again."""
        fleet = self.prepared(4)
        biddings = self.enter(fleet, 3.0, 1.0, 2.0)
        fleet.run(1.0)
        biddings[1].withdraw()
        fleet.run(2.0)
        self.assertEqual([r.cost for r in self.views[0][-1]], [2.0, 3.0])
        biddings[1].report(Report(fleet.nodes[1].uuid, 0.5))
        fleet.run(2.0)
        self.assertEqual([r.cost for r in self.views[0][-1]], [0.5, 2.0, 3.0])
        before = len(self.views[0])
        biddings[1].report(Report(fleet.nodes[1].uuid, 0.5))
        fleet.run(2.0)
        self.assertEqual(len(self.views[0]), before)

    def test_restarted_bidder(self) -> None:
        """A restarted node can bid again, although it had sent more revisions of its bid before the restart."""
        fleet = self.prepared(4)
        biddings = self.enter(fleet, 3.0, 4.0, 5.0, 6.0)
        place = fleet.nodes.index(self.outsider(fleet))
        for cost in (2.5, 2.4, 2.3):
            biddings[place].report(Report(fleet.nodes[place].uuid, cost))
        fleet.run(2.0)
        fleet.nodes[place].stop_silently()
        fleet.nodes[place] = fleet.make_node(place)
        fleet.nodes[place].startService()
        fleet.run(2.0)
        node = fleet.nodes[place]
        node.start_bidding(self.task, 1, self.views[place].append).report(Report(node.uuid, 9.0))
        fleet.run(4.0)
        for other in range(4):
            costs = {r.agent: r.cost for r in self.views[other][-1]}
            self.assertEqual(costs[node.uuid], 9.0)

    def test_bad_bids_are_errors(self) -> None:
        """A bid with an invalid cost, or for another agent, raises ``ValueError``."""
        fleet = self.prepared(3)
        [bidding] = self.enter(fleet, 3.0)
        for cost in (math.nan, math.inf, -1.0):
            with self.assertRaises(ValueError):
                bidding.report(Report(fleet.nodes[0].uuid, cost))
        with self.assertRaises(ValueError):
            bidding.report(Report(fleet.nodes[1].uuid, 1.0))

    def test_listener_that_raises(self) -> None:
        """A callback that raises an exception does not affect other bidders."""
        fleet = self.prepared(4)
        self.enter(fleet, 3.0, 1.0, 2.0)
        fleet.nodes[0].start_bidding(self.task, 1, lambda reports: 1 // 0)  # type: ignore[arg-type]
        fleet.run(2.0)
        self.assertEqual(len(self.flushLoggedErrors(ZeroDivisionError)), 1)
        self.assertNotEqual(self.views[0], [])


class HostileTests(AuctionCase):
    """Tests with a dishonest member of the team."""

    def test_announcement_of_a_stranger(self) -> None:
        """An announcement by a node outside the council is rejected with a reason, and changes no bidder's view."""
        fleet = self.prepared(5)
        self.enter(fleet, 3.0, 1.0, 2.0, 4.0, 5.0)
        liar = self.outsider(fleet)
        victim = next(node for node in fleet.nodes if node is not liar)
        auction = self.auction()
        lie = (AnnouncedReport(Report(liar.uuid, 0.0)),)
        for rank in range(3):
            forged = Announcement(99, rank, lie).sign(liar.entangled.identity.sign, auction)
            answer = self.ask(fleet, liar, victim, "bid.announce", auction.pack(), forged.pack())
            self.assertIsInstance(answer, Refused)
            self.assertIn("not signed by a quorum member of the task", str(answer))
        fleet.run(2.0)
        for place in range(5):
            self.assertEqual(self.views[place][-1][0].agent, fleet.nodes[1].uuid)

    def test_announcement_in_return_for_a_bid(self) -> None:
        """An announcement in the answer to a bid is checked like any other announcement."""
        fleet = self.prepared(4)
        self.enter(fleet, 3.0, 1.0)
        node, liar = fleet.nodes[0], self.outsider(fleet)
        auction = self.auction()
        forged = Announcement(99, 0, (AnnouncedReport(Report(liar.uuid, 0.0)),)).sign(
            liar.entangled.identity.sign, auction
        )
        bidder = next(iter(node.auction_service._participants))
        with self.assertRaises(Refused):
            node.auction_service._process_announcement(bidder, forged.pack())

    def test_bids_for_others(self) -> None:
        """An offer is rejected completely if one of its bids is not signed by its agent for this auction."""
        fleet = self.prepared(4)
        liar, victim = fleet.nodes[3], fleet.nodes[0]
        auction, other = self.auction(), Auction("job", 2, self.task.council, "nearest", WAITING)
        own = liar.entangled.identity
        bids = [
            Bid(fleet.nodes[1].entangled.identity.public, Report(fleet.nodes[1].uuid, 0.0), 0, b"x" * 64),
            Bid(own.public, Report(liar.uuid, 0.0)).sign(own, other),
        ]
        for bid in bids:
            answer = self.ask(fleet, liar, victim, "bid.offer", auction.pack(), [bid.pack()], 0, False)
            self.assertIsInstance(answer, Refused)

    def test_bids_of_those_who_may_not(self) -> None:
        """A bid of an agent that may not bid is ignored; an offer that contains only such bids is rejected."""
        fleet = self.prepared(4)
        viewer, victim, good = fleet.nodes[3], fleet.nodes[0], fleet.nodes[1]
        public, auction = viewer.entangled.identity.public, self.auction()
        victim.entangled.replica.may_store = lambda slot: slot.owner != public or slot.name != MEMBER
        bids = [
            Bid(node.entangled.identity.public, Report(node.uuid, 1.0)).sign(node.entangled.identity, auction).pack()
            for node in (viewer, good)
        ]
        answer = self.ask(fleet, viewer, victim, "bid.offer", auction.pack(), bids[:1], 0, False)
        self.assertEqual(getattr(answer, "code", ""), ROLE)
        self.assertEqual(len(list(victim.auction_service._participants)), 0)
        answer = self.ask(fleet, viewer, victim, "bid.offer", auction.pack(), bids, 0, False)
        self.assertNotIsInstance(answer, Refused)
        bidder = next(iter(victim.auction_service._participants))
        self.assertIsNone(bidder.summary.get(viewer.uuid))
        self.assertIsNotNone(bidder.summary.get(good.uuid))

    def test_nonsense(self) -> None:
        """Invalid arguments are rejected with a one-line reason, and change nothing."""
        fleet = self.prepared(3)
        liar, victim = fleet.nodes[0], fleet.nodes[1]
        own, auction = liar.entangled.identity, self.auction()
        good = Bid(own.public, Report(liar.uuid, 1.0)).sign(own, auction).pack()
        questions: list[tuple[object, ...]] = [
            ("bid.offer", [], [good], 0, False),
            ("bid.offer", auction.pack(), [good] * (MAX_BIDS_PER_MESSAGE + 1), 0, False),
            ("bid.offer", auction.pack(), [[1, 2, 3]], 0, False),
            ("bid.offer", auction.pack(), [good], -1, False),
            ("bid.offer", auction.pack(), [good], 10**12, False),
            ("bid.offer", auction.pack(), "bids", 0, False),
            ("bid.announce", auction.pack(), 7),
            ("bid.announce", 7, []),
        ]
        for method, *arguments in questions:
            answer = self.ask(fleet, liar, victim, str(method), *arguments)
            self.assertIsInstance(answer, Refused, (method, answer))
        liar.entangled.endpoint.notify(victim.entangled.contact, "bid.cry", auction.pack(), [good])
        fleet.run(1.0)
        self.assertEqual(len(list(victim.auction_service._participants)), 0)

    def test_invented_auctions(self) -> None:
        """A peer that invents auctions fills a limited table, and leaves no timer behind."""
        fleet = self.prepared(3)
        liar, victim = fleet.nodes[0], fleet.nodes[1]
        [bidding] = self.enter(fleet, 3.0)
        bidding_of_victim = victim.start_bidding(self.task, 1, self.views[1].append)
        own = liar.entangled.identity
        for epoch in range(MAX_PARTICIPANTS + 20):
            auction = Auction("job", 1_000 + epoch, self.task.council, "nearest", WAITING)
            bid = Bid(own.public, Report(liar.uuid, 1.0)).sign(own, auction)
            peer = liar.entangled.contact
            victim.auction_service.answer_offer(peer, auction.pack(), [bid.pack()], 0, True)
        self.assertEqual(len(victim.auction_service._participants), MAX_PARTICIPANTS)
        self.assertLessEqual(len(victim.auction_service._timers), MAX_PARTICIPANTS)
        bidding_of_victim.report(Report(victim.uuid, 1.0))
        fleet.run(2.0)
        self.assertEqual(self.views[1][-1][0].agent, victim.uuid)

    def test_unknown_strategy(self) -> None:
        """A node that does not have the task's strategy still forwards bids."""
        fleet = self.prepared(4, strategy="nobody-has-this")
        self.enter(fleet, 3.0, 1.0, 2.0)
        fleet.run(2.0)
        self.assertEqual(self.views[0][-1][0].agent, fleet.nodes[1].uuid)

    def test_vanished_council(self) -> None:
        """A best-effort task is decided even if its council fails; a stopped node leaves no timer behind."""
        fleet = self.prepared(8)
        members = {member.node_id for member in self.task.council}
        for node in fleet.nodes:
            if node.entangled.identity.node_id in members:
                node.stop_silently()
        left = [place for place, node in enumerate(fleet.nodes) if node.running]
        auction = self.auction(exclusive=False)
        for place in left:
            node = fleet.nodes[place]
            node.auction_service.take_part(auction, self.views[place].append).report(Report(node.uuid, 1.0 + place))
        fleet.run(8.0)
        self.assertEqual({self.views[place][-1][0].agent for place in left}, {fleet.nodes[left[0]].uuid})
