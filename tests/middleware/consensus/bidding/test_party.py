"""Tests of the parts of a party: bidder, relay, council member, and the flooding of bids without a council."""

from __future__ import annotations

import math
import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.auctions import LIFE_S, MAX_PARTIES, OWN, Parties
from middleware.consensus.bidding.audience import MAX_LISTENERS, PAUSES, Audience
from middleware.consensus.bidding.check import MAX_RELAYED
from middleware.consensus.bidding.errand import Cry, Errand, Notice, Offer
from middleware.consensus.bidding.party import Party
from middleware.consensus.bidding.scale import DIRECT, LEAST_TREE, MOST_DIRECT, NEAR, TREE, Scale, team_size
from middleware.consensus.bidding.tree import MAX_CHILDREN, hops, shared_bits
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
    party,
)


def offers(errands: list[Errand]) -> list[Offer]:
    """Return the offers among ``errands``."""
    return [errand for errand in errands if isinstance(errand, Offer)]


def notices(errands: list[Errand]) -> list[Notice]:
    """Return the notices among ``errands``."""
    return [errand for errand in errands if isinstance(errand, Notice)]


class RouteTests(SynchronousTestCase):
    def test_each_hop_is_nearer(self) -> None:
        """Next hops are nearer to the key than the node, the nearest first, followed by the council."""
        own = CONTACTS[5].node_id
        found = hops(AUCTION, own, CONTACTS)
        ahead = [c for c in found if c not in COUNCIL]
        apart = [distance(c.node_id, AUCTION.key) for c in ahead]
        self.assertEqual(apart, sorted(apart))
        self.assertTrue(all(each < distance(own, AUCTION.key) for each in apart))
        self.assertEqual([c for c in found if c in COUNCIL][-1], found[-1])

    def test_nobody_nearer(self) -> None:
        """A node without a nearer contact sends to the council, and never to itself."""
        self.assertEqual(hops(AUCTION, CONTACTS[5].node_id, []), list(COUNCIL))
        self.assertEqual(hops(AUCTION, COUNCIL[0].node_id, []), list(COUNCIL[1:]))

    def test_council_is_the_goal(self) -> None:
        """If the nearest contact is a council member, it is the next hop, followed by the other members."""
        key = AUCTION.key
        member = min(CONTACTS, key=lambda c: distance(c.node_id, key))
        auction = Auction(AUCTION.task_id, 1, (CONTACTS[11], member))
        far = max(CONTACTS, key=lambda c: distance(c.node_id, key))
        self.assertEqual(hops(auction, far.node_id, CONTACTS), [member, CONTACTS[11]])


class ScaleTests(SynchronousTestCase):
    def test_goes_over_once(self) -> None:
        """The choice between direct bids and the tree has a hysteresis."""
        scale = Scale()
        ways = [scale.counted(n) for n in (1, MOST_DIRECT, MOST_DIRECT + 1, MOST_DIRECT, LEAST_TREE, LEAST_TREE - 1)]
        self.assertEqual(ways, [DIRECT, DIRECT, TREE, TREE, TREE, DIRECT])
        self.assertEqual(scale.counted(MOST_DIRECT), DIRECT)

    def test_team_size(self) -> None:
        """A small team is counted; the size of a large team is estimated from the density of the nearest nodes."""
        own = CONTACTS[0].node_id
        self.assertEqual(team_size(own, [], False), 1)
        self.assertEqual(team_size(own, CONTACTS[1:], False), len(CONTACTS))
        rng = random.Random(1)
        many = [Contact(rng.randbytes(32), Address("10.0.0.1", 1)) for _ in range(4_000)]
        near = sorted(many, key=lambda c: distance(c.node_id, own))
        known = near[:40] + rng.sample(near[40:], 40)
        self.assertTrue(1_500 < team_size(own, known, False) < 12_000)
        newcomer = near[:NEAR] + rng.sample(near[NEAR:], NEAR)  # knows few contacts yet, but that there are many
        self.assertTrue(1_500 < team_size(own, newcomer, True) < 12_000)
        self.assertEqual(team_size(own, newcomer[: NEAR - 1], True), NEAR)


class AudienceTests(SynchronousTestCase):
    def test_told_once(self) -> None:
        """A listener receives each announcement once; after losses it is repeated with increasing pauses."""
        audience = Audience()
        audience.add(CONTACTS[5])
        one = announced(1, 0)
        [notice] = audience.notices(one, True, 0.0)
        self.assertEqual(audience.notices(one, True, 0.0), [])
        now = 0.0
        for pause in PAUSES:
            audience.failed(notice, now)
            self.assertEqual(audience.due(one, True), now + pause)
            now += pause
            [notice] = audience.notices(one, True, now)
        audience.failed(notice, now)
        self.assertEqual(audience.due(one, True), math.inf)
        self.assertEqual(audience.notices(one, True, 1e9), [])
        audience.add(CONTACTS[5])
        [notice] = audience.notices(one, True, now)
        audience.answered(notice)
        self.assertEqual(audience.notices(one, True, now), [])
        self.assertEqual(len(audience.notices(announced(2, 0), True, now)), 1)

    def test_shared_listeners(self) -> None:
        """A bidder that sent to the whole council receives an announcement only from the member that made it."""
        audience = Audience()
        audience.add(CONTACTS[5], is_shared=True)
        self.assertEqual(audience.notices(announced(1, 1), False, 0.0), [])
        self.assertEqual(len(audience.notices(announced(1, 1), True, 0.0)), 1)

    def test_room(self) -> None:
        """The oldest listener is removed if there are too many."""
        audience = Audience()
        for number in range(MAX_LISTENERS + 1):
            audience.add(Contact(number.to_bytes(32), Address("10.0.0.1", 1)))
        self.assertEqual(len(audience), MAX_LISTENERS)


class BidderTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.told: list[list[float]] = []
        self.party = party(5, on_summary=lambda reports: self.told.append([r.cost for r in reports]))

    def test_direct(self) -> None:
        """In a small team a bid is sent to each member of the council, and repeated if it is not confirmed."""
        self.party.bid(bid(5, 2.0), DIRECT, 0.0)
        sent = offers(self.party.errands(0.0))
        self.assertEqual([offer.to for offer in sent], list(COUNCIL))
        self.assertTrue(all(offer.is_shared for offer in sent))
        self.party.answered(sent[0], 0.1)
        self.party.answered(sent[1], 0.1)
        self.party.failed(sent[2], 0.4)
        again = offers(self.party.errands(self.party.due))
        self.assertEqual([offer.to for offer in again], [COUNCIL[2]])

    def test_new_bid_while_the_old_one_is_under_way(self) -> None:
        """A confirmation applies to the bid that was sent, not to a newer one."""
        self.party.bid(bid(5, 2.0), DIRECT, 0.0)
        sent = offers(self.party.errands(0.0))
        self.party.bid(bid(5, 1.0, 1), DIRECT, 0.01)
        for offer in sent:
            self.party.answered(offer, 0.1)
        newer = offers(self.party.errands(0.1))
        self.assertEqual([offer.bids[0].revision for offer in newer], [1, 1, 1])

    def test_own_bid_beats_what_is_announced(self) -> None:
        """A bidder with a better bid than the announced one sends it directly within half a waiting period."""
        self.party.bid(bid(5, 2.0), TREE, 0.0)
        self.party.announced(announced(1, 0, bid(6, 3.0)), 0.6)
        due = self.party.due
        self.party._branch._send_at = math.inf
        self.assertTrue(0.6 <= self.party.due <= 0.6 + AUCTION.waiting / 2, due)
        [straight] = [o for o in offers(self.party.errands(self.party.due)) if o.is_straight]
        self.assertEqual((straight.to, straight.bids), (COUNCIL[0], (bid(5, 2.0),)))

    def test_own_bid_that_does_not_matter(self) -> None:
        """A bidder with a worse bid than the announced one does not contact the council."""
        self.party.bid(bid(5, 4.0), TREE, 0.0)
        self.party.announced(announced(1, 0, bid(6, 3.0)), 0.6)
        self.assertEqual([o for t in range(10) for o in offers(self.party.errands(float(t))) if o.is_straight], [])

    def test_silence(self) -> None:
        """A bidder that receives no announcement queries the council members in turn."""
        self.party.bid(bid(5, 2.0), TREE, 0.0)
        asked: list[Contact] = []
        now = 0.0
        for _ in range(20):
            now = max(now, min(self.party.due, 5.0))
            for offer in offers(self.party.errands(now)):
                if offer.is_straight:
                    asked.append(offer.to)
                    self.party.failed(offer, now)
                else:
                    self.party.answered(offer, now)
            if len(asked) == 4:
                break
        self.assertEqual(asked, [*COUNCIL, COUNCIL[0]])
        self.assertTrue(now < 5.0)

    def test_taken_back_but_still_announced(self) -> None:
        """A bidder sends its withdrawal again while the council still announces its bid."""
        self.party.bid(bid(5, 2.0), DIRECT, 0.0)
        for offer in offers(self.party.errands(0.0)):
            self.party.answered(offer, 0.0)
        self.party.bid(bid(5, None, 1), DIRECT, 0.1)
        for offer in offers(self.party.errands(0.1)):
            self.party.failed(offer, 0.1)
        self.party.announced(announced(1, 0, bid(5, 2.0)), 0.6)
        sent = [offer for offer in offers(self.party.errands(2.0)) if offer.is_straight]
        self.assertEqual([offer.bids for offer in sent], [(bid(5, None, 1),)])

    def test_bid_of_a_former_life(self) -> None:
        """A restarted bidder learns its last revision from the announcement."""
        self.party.bid(bid(5, 9.0), DIRECT, 0.0)
        self.party.announced(announced(1, 0, bid(5, 1.0, 7)), 0.6)
        self.assertTrue(self.party.is_outlived)
        self.party.bid(bid(5, 9.0, self.party.next_revision), DIRECT, 0.6)
        self.assertFalse(self.party.is_outlived)
        self.assertGreater(self.party.next_revision, 8)

    def test_later_announcements(self) -> None:
        """Only an announcement with precedence is reported, in any order of arrival, and none is reported twice."""
        for announcement in (announced(2, 0, bid(6, 1.0)), announced(1, 0, bid(7, 0.5)), announced(2, 1, bid(8, 0.2))):
            self.party.announced(announcement, 1.0)
        self.party.announced(announced(3, 1, bid(6, 1.0)), 1.0)
        self.assertEqual(self.told, [[1.0]])


class BranchTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.party = party(5)

    def test_one_message_for_many(self) -> None:
        """Bids from several children within the wait are sent in one offer to one contact nearer to the key."""
        for place in (6, 7, 8):
            self.party.offered([bid(place, float(place))], CONTACTS[place], 0.0, False, 0.0)
        [up] = offers(self.party.errands(self.party.due))
        self.assertEqual([b.agent for b in up.bids], sorted(AGENTS[place].node_id.hex() for place in (6, 7, 8)))
        self.assertEqual(up.to, hops(AUCTION, CONTACTS[5].node_id, CONTACTS)[0])

    def test_nearer_ones_wait_longer(self) -> None:
        """Nodes nearer to the key wait longer for their children, up to half the waiting period."""
        waits = []
        for contact in sorted(CONTACTS[3:], key=lambda c: shared_bits(c.node_id, AUCTION.key)):
            one = party(CONTACTS.index(contact))
            one.offered([bid(6, 1.0)], CONTACTS[6], 0.0, False, 0.0)
            waits.append(one.due)
        self.assertEqual(waits, sorted(waits))
        self.assertEqual(waits[0], 0.0)
        self.assertTrue(0.02 < waits[-1] <= AUCTION.waiting / 2)

    def test_next_nearest(self) -> None:
        """If the parent does not answer, bids are sent to the next nearest contact, and finally to the council."""
        self.party.offered([bid(6, 1.0)], CONTACTS[6], 0.0, False, 0.0)
        expected = hops(AUCTION, CONTACTS[5].node_id, [c for c in CONTACTS if c is not CONTACTS[5]])
        self.assertEqual(len(expected), 4 + len(COUNCIL))
        asked = []
        for _ in expected:
            [up] = [o for o in offers(self.party.errands(self.party.due)) if not o.is_straight]
            asked.append(up.to)
            self.party.failed(up, 0.3)
        self.assertEqual(asked, expected)

    def test_confirmed_is_not_sent_again(self) -> None:
        """Only bids that the parent lacks are sent; a duplicate from a child sends nothing."""
        self.party.offered([bid(6, 1.0)], CONTACTS[6], 0.0, False, 0.0)
        [up] = offers(self.party.errands(self.party.due))
        self.party.answered(up, 0.2)
        self.party.offered([bid(6, 1.0)], CONTACTS[6], 0.0, False, 0.3)
        self.party.offered([bid(7, 0.5)], CONTACTS[7], 0.0, False, 0.3)
        [more] = offers(self.party.errands(self.party.due))
        self.assertEqual([b.report and b.report.cost for b in more.bids], [0.5])

    def test_announcement_goes_down(self) -> None:
        """Each child receives the announcement, a late child in the answer to its offer."""
        for place in (6, 7):
            self.party.offered([bid(place, 1.0)], CONTACTS[place], 0.0, False, 0.0)
        word = announced(1, 0, bid(6, 1.0))
        self.party.announced(word, 0.6)
        self.assertEqual([n.to for n in notices(self.party.errands(0.6))], [CONTACTS[6], CONTACTS[7]])
        self.assertIs(self.party.offered([bid(8, 9.0)], CONTACTS[8], 0.0, False, 0.7), word)
        self.assertEqual(notices(self.party.errands(0.7)), [])

    def test_relay_asks_for_those_behind(self) -> None:
        """A relay queries the council for its children if no announcement arrives, up to a limit."""
        self.party.offered([bid(6, 1.0)], CONTACTS[6], 0.0, False, 0.0)
        straight = 0
        for step in range(600):
            for offer in offers(self.party.errands(step * 0.1)):
                straight += offer.is_straight
                self.party.answered(offer, step * 0.1)
        self.assertEqual(straight, MAX_RELAYED)

    def test_the_council_hears_everybody(self) -> None:
        """A council member accepts any number of children, because they have no other destination."""
        member = party(0)
        for number in range(MAX_CHILDREN + 1):
            member.offered([], Contact(number.to_bytes(32), Address("10.0.0.1", 1)), 0.0, False, 0.0)
        self.assertTrue(member.has_room(CONTACTS[6]))


class TellerTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.first, self.second = party(0), party(1)

    def take(
        self, member: Party, place: int, cost: float | None, now: float, revision: int = 0, shared: bool = True
    ) -> None:
        """Let a member of the council receive a bid."""
        member.offered([bid(place, cost, revision)], CONTACTS[place], 0.0, shared, now)

    def test_closes_after_the_waiting_period(self) -> None:
        """The first member announces at the end of the waiting period, counted from the first bid at any node."""
        self.first.offered([bid(5, 2.0)], CONTACTS[5], 0.2, True, 1.0)
        self.first.errands(1.29)
        self.assertIsNone(self.first.announcement)
        self.assertAlmostEqual(self.first.due, 1.3)
        told = notices(self.first.errands(1.3))
        self.assertEqual({n.to for n in told}, {CONTACTS[5], *COUNCIL[1:]})
        assert self.first.announcement is not None
        self.assertTrue(self.first.announcement.is_genuine(AUCTION))

    def test_closes_when_all_have_bid(self) -> None:
        """The waiting period ends early once every expected agent has bid or abstained."""
        self.first.expect(2)
        self.take(self.first, 5, 2.0, 0.0)
        self.take(self.first, 6, None, 0.1)
        self.assertEqual(len(notices(self.first.errands(0.1))), 4)

    def test_next_member_stands_in(self) -> None:
        """If the first member is silent the second announces; after an announcement of the first it does not."""
        self.take(self.second, 5, 2.0, 0.0)
        self.second.errands(0.6)
        self.assertIsNone(self.second.announcement)
        self.assertTrue(0.6 < self.second.due < 1.0)
        self.second.errands(self.second.due)
        assert self.second.announcement is not None
        self.assertEqual(self.second.announcement.precedence, (1, -1))
        third = party(2)
        self.take(third, 5, 2.0, 0.0)
        third.announced(announced(1, 0, bid(5, 2.0)), 0.5)
        third.errands(5.0)
        self.assertEqual(third.announcement, announced(1, 0, bid(5, 2.0)))

    def test_late_bid_that_matters(self) -> None:
        """A late bid that changes the winner is announced; in a large team any other late bid is not."""
        for place in (5, 6, 7):
            self.take(self.first, place, float(place), 0.0, shared=False)
        self.first.errands(0.5)
        self.take(self.first, 8, 8.0, 0.9, shared=False)
        self.first.errands(2.0)
        assert self.first.announcement is not None
        self.assertEqual(self.first.announcement.number, 1)
        self.take(self.first, 9, 1.0, 2.1, shared=False)
        self.first.errands(self.first.due)
        self.assertEqual(self.first.announcement.number, 2)
        self.assertEqual(self.first.announcement.reports[0].cost, 1.0)

    def test_fellows_share(self) -> None:
        """A member forwards to other members the bids that only it received."""
        self.take(self.second, 5, 2.0, 0.0, shared=True)
        self.assertEqual(offers(self.second.errands(0.3)), [])
        self.take(self.second, 6, 1.0, 0.3, shared=False)
        sent = offers(self.second.errands(0.41))
        self.assertEqual({o.to for o in sent}, {COUNCIL[0], COUNCIL[2]})
        self.assertTrue(all(b.report and b.report.cost == 1.0 for o in sent for b in o.bids))


class FloodTests(SynchronousTestCase):
    def cut_off(self, auction: Auction) -> list[Errand]:
        """Return the messages of a bidder that cannot reach the council."""
        one = party(5, auction)
        one.bid(bid(5, 2.0, auction=auction), DIRECT, 0.0)
        sent: list[Errand] = []
        for step in range(40):
            for errand in one.errands(step * 0.1):
                sent.append(errand)
                if isinstance(errand, Offer):
                    one.failed(errand, step * 0.1)
        return sent

    def test_only_best_effort(self) -> None:
        """If no council member answers, bids are flooded to eight neighbours, except those for an exclusive task."""
        cries = [e for e in self.cut_off(BEST_EFFORT) if isinstance(e, Cry)]
        self.assertEqual(len({cry.to.node_id for cry in cries}), 8)
        self.assertEqual([e for e in self.cut_off(AUCTION) if isinstance(e, Cry)], [])

    def test_each_change_once(self) -> None:
        """A node forwards flooded bids once, and reports them at the end of the waiting period."""
        told: list[list[float]] = []
        one = party(5, BEST_EFFORT, on_summary=lambda reports: told.append([r.cost for r in reports]))
        one.cried([bid(6, 1.0, auction=BEST_EFFORT)], CONTACTS[6], 0.0)
        self.assertEqual(len(one.errands(0.0)), 8)
        one.cried([bid(6, 1.0, auction=BEST_EFFORT)], CONTACTS[7], 0.1)
        self.assertEqual(one.errands(0.1), [])
        self.assertEqual(told, [])
        one.errands(one.due)
        self.assertEqual(told, [[1.0]])


class PartiesTests(SynchronousTestCase):
    def made(self, number: int) -> Party:
        """Return a party in one of many auctions."""
        return party(5, Auction(f"job {number}", 1, COUNCIL))

    def test_whoever_opens_most_makes_room(self) -> None:
        """A peer that invents auctions displaces its own parties; other peers' parties stay."""
        parties = Parties()
        own, honest = self.made(0), self.made(1)
        parties.add(own, OWN, 0.0)
        parties.add(honest, b"honest", 0.0)
        for number in range(2, MAX_PARTIES + 50):
            parties.add(self.made(number), b"liar", 1.0)
        self.assertEqual(len(parties), MAX_PARTIES)
        self.assertIs(parties.get(own.auction.digest), own)
        self.assertIs(parties.get(honest.auction.digest), honest)

    def test_idle_ones_are_forgotten(self) -> None:
        """An idle party is removed when another is added; the parties of this node stay."""
        parties = Parties()
        own, old, busy = self.made(0), self.made(1), self.made(2)
        parties.add(own, OWN, 0.0)
        parties.add(old, b"peer", 0.0)
        parties.add(busy, b"peer", 0.0)
        parties.touch(busy.auction.digest, LIFE_S)
        self.assertEqual(parties.add(self.made(3), b"peer", LIFE_S + 1.0), [old])
        self.assertEqual(len(parties), 3)
