"""Tests of a participant as bidder, relay and council member, and of bids that are flooded without a council."""

from __future__ import annotations

import math
import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.auction_service import MAX_IDLE_S, MAX_PARTICIPANTS, OWN_OPENER, ParticipantTable
from middleware.consensus.bidding.bid_delivery import MAX_RELAY_REQUESTS
from middleware.consensus.bidding.outgoing_message import FloodedBids, Notice, Offer, OutgoingMessage
from middleware.consensus.bidding.participant import Participant
from middleware.consensus.bidding.path_choice import (
    DIRECT,
    MAX_DIRECT_BIDDERS,
    MIN_TREE_BIDDERS,
    NEAREST_CONTACTS,
    TREE,
    PathChoice,
    estimate_team_size,
)
from middleware.consensus.bidding.recipients import MAX_RECIPIENTS, RETRY_PAUSES_S, Recipients
from middleware.consensus.bidding.tree import MAX_CHILDREN, count_shared_bits, find_hops
from middleware.entangled.contact import Contact
from middleware.entangled.kademlia.distance import distance
from middleware.entangled.network.network import Address
from tests.middleware.consensus.bidding.ground import (
    AGENTS,
    AUCTION,
    BEST_EFFORT,
    CONTACTS,
    COUNCIL,
    announced,
    bid,
    make_participant,
)


def offers(messages: list[OutgoingMessage]) -> list[Offer]:
    """Return the offers among ``messages``."""
    return [message for message in messages if isinstance(message, Offer)]


def notices(messages: list[OutgoingMessage]) -> list[Notice]:
    """Return the notices among ``messages``."""
    return [message for message in messages if isinstance(message, Notice)]


class RouteTests(SynchronousTestCase):
    def test_each_hop_is_nearer(self) -> None:
        """The next hops are the contacts nearer to the key than the node, nearest first, and then the council."""
        own = CONTACTS[5].node_id
        found = find_hops(AUCTION, own, CONTACTS)
        ahead = [c for c in found if c not in COUNCIL]
        apart = [distance(c.node_id, AUCTION.key) for c in ahead]
        self.assertEqual(apart, sorted(apart))
        self.assertTrue(all(each < distance(own, AUCTION.key) for each in apart))
        self.assertEqual([c for c in found if c in COUNCIL][-1], found[-1])

    def test_nobody_nearer(self) -> None:
        """A node without a nearer contact sends to the council, and never to itself."""
        self.assertEqual(find_hops(AUCTION, CONTACTS[5].node_id, []), list(COUNCIL))
        self.assertEqual(find_hops(AUCTION, COUNCIL[0].node_id, []), list(COUNCIL[1:]))

    def test_council_is_the_goal(self) -> None:
        """If the nearest contact is a council member, it is the first hop, followed by the other members."""
        key = AUCTION.key
        member = min(CONTACTS, key=lambda c: distance(c.node_id, key))
        auction = Auction(AUCTION.task_id, 1, (CONTACTS[11], member))
        far = max(CONTACTS, key=lambda c: distance(c.node_id, key))
        self.assertEqual(find_hops(auction, far.node_id, CONTACTS), [member, CONTACTS[11]])


class PathChoiceTests(SynchronousTestCase):
    def test_goes_over_once(self) -> None:
        """The team size at which bids change between direct and tree has a hysteresis."""
        path_choice = PathChoice()
        paths = [
            path_choice.choose(n)
            for n in (
                1,
                MAX_DIRECT_BIDDERS,
                MAX_DIRECT_BIDDERS + 1,
                MAX_DIRECT_BIDDERS,
                MIN_TREE_BIDDERS,
                MIN_TREE_BIDDERS - 1,
            )
        ]
        self.assertEqual(paths, [DIRECT, DIRECT, TREE, TREE, TREE, DIRECT])
        self.assertEqual(path_choice.choose(MAX_DIRECT_BIDDERS), DIRECT)

    def test_team_size(self) -> None:
        """The size of a small team is counted: a node and its contacts.

        The size of a large team is estimated from the density of the nearest nodes.
        """
        own = CONTACTS[0].node_id
        self.assertEqual(estimate_team_size(own, [], False), 1)
        self.assertEqual(estimate_team_size(own, CONTACTS[1:], False), len(CONTACTS))
        rng = random.Random(1)
        many = [Contact(rng.randbytes(32), Address("10.0.0.1", 1)) for _ in range(4_000)]
        near = sorted(many, key=lambda c: distance(c.node_id, own))
        known = near[:40] + rng.sample(near[40:], 40)
        self.assertTrue(1_500 < estimate_team_size(own, known, False) < 12_000)
        newcomer = near[:NEAREST_CONTACTS] + rng.sample(
            near[NEAREST_CONTACTS:], NEAREST_CONTACTS
        )  # the contacts are few, but the node is told that the team is large
        self.assertTrue(1_500 < estimate_team_size(own, newcomer, True) < 12_000)
        self.assertEqual(estimate_team_size(own, newcomer[: NEAREST_CONTACTS - 1], True), NEAREST_CONTACTS)


class RecipientsTests(SynchronousTestCase):
    def test_told_once(self) -> None:
        """A recipient gets each announcement once; after losses the announcement is repeated with increasing pauses."""
        recipients = Recipients()
        recipients.add(CONTACTS[5])
        one = announced(1, 0)
        [notice] = recipients.take_due_notices(one, True, 0.0)
        self.assertEqual(recipients.take_due_notices(one, True, 0.0), [])
        now = 0.0
        for pause in RETRY_PAUSES_S:
            recipients.on_failure(notice, now)
            self.assertEqual(recipients.compute_due(one, True), now + pause)
            now += pause
            [notice] = recipients.take_due_notices(one, True, now)
        recipients.on_failure(notice, now)
        self.assertEqual(recipients.compute_due(one, True), math.inf)
        self.assertEqual(recipients.take_due_notices(one, True, 1e9), [])
        recipients.add(CONTACTS[5])
        [notice] = recipients.take_due_notices(one, True, now)
        recipients.on_answer(notice)
        self.assertEqual(recipients.take_due_notices(one, True, now), [])
        self.assertEqual(len(recipients.take_due_notices(announced(2, 0), True, now)), 1)

    def test_shared_listeners(self) -> None:
        """A bidder that sent its bid to the whole council gets an announcement only from its author."""
        recipients = Recipients()
        recipients.add(CONTACTS[5], is_shared=True)
        self.assertEqual(recipients.take_due_notices(announced(1, 1), False, 0.0), [])
        self.assertEqual(len(recipients.take_due_notices(announced(1, 1), True, 0.0)), 1)

    def test_room(self) -> None:
        """If there are too many recipients, the oldest recipient is removed."""
        recipients = Recipients()
        for number in range(MAX_RECIPIENTS + 1):
            recipients.add(Contact(number.to_bytes(32), Address("10.0.0.1", 1)))
        self.assertEqual(len(recipients), MAX_RECIPIENTS)


class BidderTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.told: list[list[float]] = []
        self.participant = make_participant(5, on_summary=lambda reports: self.told.append([r.cost for r in reports]))

    def test_direct(self) -> None:
        """In a small team a bid is sent to each member of the council, and sent again if it is not confirmed."""
        self.participant.make_bid(bid(5, 2.0), DIRECT, 0.0)
        sent = offers(self.participant.take_due_messages(0.0))
        self.assertEqual([offer.to for offer in sent], list(COUNCIL))
        self.assertTrue(all(offer.is_shared for offer in sent))
        self.participant.on_answer(sent[0], 0.1)
        self.participant.on_answer(sent[1], 0.1)
        self.participant.on_failure(sent[2], 0.4)
        again = offers(self.participant.take_due_messages(self.participant.due))
        self.assertEqual([offer.to for offer in again], [COUNCIL[2]])

    def test_new_bid_while_the_old_one_is_under_way(self) -> None:
        """A confirmation applies only to the bid that was sent; a newer bid of the agent remains unconfirmed."""
        self.participant.make_bid(bid(5, 2.0), DIRECT, 0.0)
        sent = offers(self.participant.take_due_messages(0.0))
        self.participant.make_bid(bid(5, 1.0, 1), DIRECT, 0.01)
        for offer in sent:
            self.participant.on_answer(offer, 0.1)
        newer = offers(self.participant.take_due_messages(0.1))
        self.assertEqual([offer.bids[0].revision for offer in newer], [1, 1, 1])

    def test_own_bid_beats_what_is_announced(self) -> None:
        """A bidder with a better bid than the announced bid sends it directly within half a waiting period."""
        self.participant.make_bid(bid(5, 2.0), TREE, 0.0)
        self.participant.on_announcement(announced(1, 0, bid(6, 3.0)), 0.6)
        due = self.participant.due
        self.participant._tree_node._send_at = math.inf
        self.assertTrue(0.6 <= self.participant.due <= 0.6 + AUCTION.waiting_period / 2, due)
        [straight] = [o for o in offers(self.participant.take_due_messages(self.participant.due)) if o.is_inquiry]
        self.assertEqual((straight.to, straight.bids), (COUNCIL[0], (bid(5, 2.0),)))

    def test_own_bid_that_does_not_matter(self) -> None:
        """A bidder with a worse bid than the announced bid does not contact the council."""
        self.participant.make_bid(bid(5, 4.0), TREE, 0.0)
        self.participant.on_announcement(announced(1, 0, bid(6, 3.0)), 0.6)
        self.assertEqual(
            [o for t in range(10) for o in offers(self.participant.take_due_messages(float(t))) if o.is_inquiry], []
        )

    def test_silence(self) -> None:
        """A bidder that receives no announcement sends queries to the council members in turn."""
        self.participant.make_bid(bid(5, 2.0), TREE, 0.0)
        asked: list[Contact] = []
        now = 0.0
        for _ in range(20):
            now = max(now, min(self.participant.due, 5.0))
            for offer in offers(self.participant.take_due_messages(now)):
                if offer.is_inquiry:
                    asked.append(offer.to)
                    self.participant.on_failure(offer, now)
                else:
                    self.participant.on_answer(offer, now)
            if len(asked) == 4:
                break
        self.assertEqual(asked, [*COUNCIL, COUNCIL[0]])
        self.assertTrue(now < 5.0)

    def test_taken_back_but_still_announced(self) -> None:
        """A bidder repeats its withdrawal until the council no longer announces the withdrawn bid."""
        self.participant.make_bid(bid(5, 2.0), DIRECT, 0.0)
        for offer in offers(self.participant.take_due_messages(0.0)):
            self.participant.on_answer(offer, 0.0)
        self.participant.make_bid(bid(5, None, 1), DIRECT, 0.1)
        for offer in offers(self.participant.take_due_messages(0.1)):
            self.participant.on_failure(offer, 0.1)
        self.participant.on_announcement(announced(1, 0, bid(5, 2.0)), 0.6)
        sent = [offer for offer in offers(self.participant.take_due_messages(2.0)) if offer.is_inquiry]
        self.assertEqual([offer.bids for offer in sent], [(bid(5, None, 1),)])

    def test_bid_of_a_former_life(self) -> None:
        """A restarted bidder learns the last revision of its bid from the announcement."""
        self.participant.make_bid(bid(5, 9.0), DIRECT, 0.0)
        self.participant.on_announcement(announced(1, 0, bid(5, 1.0, 7)), 0.6)
        self.assertTrue(self.participant.is_superseded)
        self.participant.make_bid(bid(5, 9.0, self.participant.next_revision), DIRECT, 0.6)
        self.assertFalse(self.participant.is_superseded)
        self.assertGreater(self.participant.next_revision, 8)

    def test_later_announcements(self) -> None:
        """Only an announcement with precedence over the last one is reported, and no announcement is reported twice."""
        for announcement in (announced(2, 0, bid(6, 1.0)), announced(1, 0, bid(7, 0.5)), announced(2, 1, bid(8, 0.2))):
            self.participant.on_announcement(announcement, 1.0)
        self.participant.on_announcement(announced(3, 1, bid(6, 1.0)), 1.0)
        self.assertEqual(self.told, [[1.0]])


class TreeNodeTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.participant = make_participant(5)

    def test_one_message_for_many(self) -> None:
        """Bids that several children send during the wait are forwarded in one offer to one nearer contact."""
        for place in (6, 7, 8):
            self.participant.on_offer([bid(place, float(place))], CONTACTS[place], 0.0, False, 0.0)
        [up] = offers(self.participant.take_due_messages(self.participant.due))
        self.assertEqual([b.agent for b in up.bids], sorted(AGENTS[place].node_id.hex() for place in (6, 7, 8)))
        self.assertEqual(up.to, find_hops(AUCTION, CONTACTS[5].node_id, CONTACTS)[0])

    def test_nearer_ones_wait_longer(self) -> None:
        """A node that is nearer to the key waits longer for bids of its children, up to half the waiting period."""
        waits = []
        for contact in sorted(CONTACTS[3:], key=lambda c: count_shared_bits(c.node_id, AUCTION.key)):
            one = make_participant(CONTACTS.index(contact))
            one.on_offer([bid(6, 1.0)], CONTACTS[6], 0.0, False, 0.0)
            waits.append(one.due)
        self.assertEqual(waits, sorted(waits))
        self.assertEqual(waits[0], 0.0)
        self.assertTrue(0.02 < waits[-1] <= AUCTION.waiting_period / 2)

    def test_next_nearest(self) -> None:
        """If the parent does not reply, bids are sent to the next nearest contact, and finally to the council."""
        self.participant.on_offer([bid(6, 1.0)], CONTACTS[6], 0.0, False, 0.0)
        expected = find_hops(AUCTION, CONTACTS[5].node_id, [c for c in CONTACTS if c is not CONTACTS[5]])
        self.assertEqual(len(expected), 4 + len(COUNCIL))
        asked = []
        for _ in expected:
            [up] = [o for o in offers(self.participant.take_due_messages(self.participant.due)) if not o.is_inquiry]
            asked.append(up.to)
            self.participant.on_failure(up, 0.3)
        self.assertEqual(asked, expected)

    def test_confirmed_is_not_sent_again(self) -> None:
        """A node forwards only bids that its parent does not have; a child's duplicate bid causes no message."""
        self.participant.on_offer([bid(6, 1.0)], CONTACTS[6], 0.0, False, 0.0)
        [up] = offers(self.participant.take_due_messages(self.participant.due))
        self.participant.on_answer(up, 0.2)
        self.participant.on_offer([bid(6, 1.0)], CONTACTS[6], 0.0, False, 0.3)
        self.participant.on_offer([bid(7, 0.5)], CONTACTS[7], 0.0, False, 0.3)
        [more] = offers(self.participant.take_due_messages(self.participant.due))
        self.assertEqual([b.report and b.report.cost for b in more.bids], [0.5])

    def test_announcement_goes_down(self) -> None:
        """Each child receives the announcement; a late child receives it in the answer to its offer."""
        for place in (6, 7):
            self.participant.on_offer([bid(place, 1.0)], CONTACTS[place], 0.0, False, 0.0)
        word = announced(1, 0, bid(6, 1.0))
        self.participant.on_announcement(word, 0.6)
        self.assertEqual([n.to for n in notices(self.participant.take_due_messages(0.6))], [CONTACTS[6], CONTACTS[7]])
        self.assertIs(self.participant.on_offer([bid(8, 9.0)], CONTACTS[8], 0.0, False, 0.7), word)
        self.assertEqual(notices(self.participant.take_due_messages(0.7)), [])

    def test_relay_asks_for_those_behind(self) -> None:
        """If no announcement arrives, a relay sends queries to the council on behalf of its children, up to a limit."""
        self.participant.on_offer([bid(6, 1.0)], CONTACTS[6], 0.0, False, 0.0)
        straight = 0
        for step in range(600):
            for offer in offers(self.participant.take_due_messages(step * 0.1)):
                straight += offer.is_inquiry
                self.participant.on_answer(offer, step * 0.1)
        self.assertEqual(straight, MAX_RELAY_REQUESTS)

    def test_the_council_hears_everybody(self) -> None:
        """A council member accepts any number of children, because they have no other destination."""
        member = make_participant(0)
        for number in range(MAX_CHILDREN + 1):
            member.on_offer([], Contact(number.to_bytes(32), Address("10.0.0.1", 1)), 0.0, False, 0.0)
        self.assertTrue(member.has_room(CONTACTS[6]))


class AnnouncerTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.first, self.second = make_participant(0), make_participant(1)

    def take(
        self, member: Participant, place: int, cost: float | None, now: float, revision: int = 0, shared: bool = True
    ) -> None:
        """Let a council member receive the bid of the agent with index ``place``."""
        member.on_offer([bid(place, cost, revision)], CONTACTS[place], 0.0, shared, now)

    def test_closes_after_the_waiting_period(self) -> None:
        """The first member announces at the end of the waiting period, which starts with the first bid at any node."""
        self.first.on_offer([bid(5, 2.0)], CONTACTS[5], 0.2, True, 1.0)
        self.first.take_due_messages(1.29)
        self.assertIsNone(self.first.announcement)
        self.assertAlmostEqual(self.first.due, 1.3)
        told = notices(self.first.take_due_messages(1.3))
        self.assertEqual({n.to for n in told}, {CONTACTS[5], *COUNCIL[1:]})
        assert self.first.announcement is not None
        self.assertTrue(self.first.announcement.is_genuine(AUCTION))

    def test_closes_when_all_have_bid(self) -> None:
        """The waiting period ends early when every expected agent has bid or abstained."""
        self.first.expect_bidders(2)
        self.take(self.first, 5, 2.0, 0.0)
        self.take(self.first, 6, None, 0.1)
        self.assertEqual(len(notices(self.first.take_due_messages(0.1))), 4)

    def test_next_member_stands_in(self) -> None:
        """If the first member is silent and has not announced, the second member announces."""
        self.take(self.second, 5, 2.0, 0.0)
        self.second.take_due_messages(0.6)
        self.assertIsNone(self.second.announcement)
        self.assertTrue(0.6 < self.second.due < 1.0)
        self.second.take_due_messages(self.second.due)
        assert self.second.announcement is not None
        self.assertEqual(self.second.announcement.precedence, (1, -1))
        third = make_participant(2)
        self.take(third, 5, 2.0, 0.0)
        third.on_announcement(announced(1, 0, bid(5, 2.0)), 0.5)
        third.take_due_messages(5.0)
        self.assertEqual(third.announcement, announced(1, 0, bid(5, 2.0)))

    def test_late_bid_that_matters(self) -> None:
        """A late bid is announced if it changes the winner; in a small team every late bid is announced."""
        for place in (5, 6, 7):
            self.take(self.first, place, float(place), 0.0, shared=False)
        self.first.take_due_messages(0.5)
        self.take(self.first, 8, 8.0, 0.9, shared=False)
        self.first.take_due_messages(2.0)
        assert self.first.announcement is not None
        self.assertEqual(self.first.announcement.number, 1)
        self.take(self.first, 9, 1.0, 2.1, shared=False)
        self.first.take_due_messages(self.first.due)
        self.assertEqual(self.first.announcement.number, 2)
        self.assertEqual(self.first.announcement.reports[0].cost, 1.0)

    def test_fellows_share(self) -> None:
        """A member forwards to the other members those bids that only it received."""
        self.take(self.second, 5, 2.0, 0.0, shared=True)
        self.assertEqual(offers(self.second.take_due_messages(0.3)), [])
        self.take(self.second, 6, 1.0, 0.3, shared=False)
        sent = offers(self.second.take_due_messages(0.41))
        self.assertEqual({o.to for o in sent}, {COUNCIL[0], COUNCIL[2]})
        self.assertTrue(all(b.report and b.report.cost == 1.0 for o in sent for b in o.bids))


class FloodTests(SynchronousTestCase):
    def cut_off(self, auction: Auction) -> list[OutgoingMessage]:
        """Return the messages of a bidder that cannot reach the council."""
        one = make_participant(5, auction)
        one.make_bid(bid(5, 2.0, auction=auction), DIRECT, 0.0)
        sent: list[OutgoingMessage] = []
        for step in range(40):
            for message in one.take_due_messages(step * 0.1):
                sent.append(message)
                if isinstance(message, Offer):
                    one.on_failure(message, step * 0.1)
        return sent

    def test_only_best_effort(self) -> None:
        """If no council member replies, bids are flooded to eight neighbours, except for an exclusive task."""
        floods = [e for e in self.cut_off(BEST_EFFORT) if isinstance(e, FloodedBids)]
        self.assertEqual(len({flood.to.node_id for flood in floods}), 8)
        self.assertEqual([e for e in self.cut_off(AUCTION) if isinstance(e, FloodedBids)], [])

    def test_each_change_once(self) -> None:
        """A node forwards each flooded bid once, and reports the bids at the end of the waiting period."""
        told: list[list[float]] = []
        one = make_participant(5, BEST_EFFORT, on_summary=lambda reports: told.append([r.cost for r in reports]))
        one.on_flood([bid(6, 1.0, auction=BEST_EFFORT)], CONTACTS[6], 0.0)
        self.assertEqual(len(one.take_due_messages(0.0)), 8)
        one.on_flood([bid(6, 1.0, auction=BEST_EFFORT)], CONTACTS[7], 0.1)
        self.assertEqual(one.take_due_messages(0.1), [])
        self.assertEqual(told, [])
        one.take_due_messages(one.due)
        self.assertEqual(told, [[1.0]])


class ParticipantTableTests(SynchronousTestCase):
    def made(self, number: int) -> Participant:
        """Return a participant in one of many auctions."""
        return make_participant(5, Auction(f"job {number}", 1, COUNCIL))

    def test_whoever_opens_most_makes_room(self) -> None:
        """If the table is full, a peer that invents auctions displaces its own entries; entries of other peers stay."""
        participants = ParticipantTable()
        own, honest = self.made(0), self.made(1)
        participants.add(own, OWN_OPENER, 0.0)
        participants.add(honest, b"honest", 0.0)
        for number in range(2, MAX_PARTICIPANTS + 50):
            participants.add(self.made(number), b"liar", 1.0)
        self.assertEqual(len(participants), MAX_PARTICIPANTS)
        self.assertIs(participants.get(own.auction.digest), own)
        self.assertIs(participants.get(honest.auction.digest), honest)

    def test_idle_ones_are_forgotten(self) -> None:
        """An idle entry is removed when a new entry is added; entries of this node's own auctions stay."""
        participants = ParticipantTable()
        own, old, busy = self.made(0), self.made(1), self.made(2)
        participants.add(own, OWN_OPENER, 0.0)
        participants.add(old, b"peer", 0.0)
        participants.add(busy, b"peer", 0.0)
        participants.touch(busy.auction.digest, MAX_IDLE_S)
        self.assertEqual(participants.add(self.made(3), b"peer", MAX_IDLE_S + 1.0), [old])
        self.assertEqual(len(participants), 3)
