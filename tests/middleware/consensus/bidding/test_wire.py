"""Tests of the encoding of auctions, bids and announcements, and of their signatures."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.bidding.announcement import parse_announcement
from middleware.consensus.bidding.auction import Auction, parse_auction
from middleware.consensus.bidding.bid import parse_bid, parse_report
from tests.middleware.consensus.bidding.ground import AGENTS, AUCTION, CONTACTS, COUNCIL, announced, bid

leaves = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary()
anything = st.recursive(leaves, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=12)


def sent(content: Any) -> Any:
    """Return ``content`` after it was encoded and decoded."""
    return msgpack.unpackb(msgpack.packb(content))


class WireTests(SynchronousTestCase):
    def test_comes_as_it_went(self) -> None:
        """An auction, a bid, its withdrawal and an announcement survive encoding with valid signatures."""
        auction = parse_auction(sent(AUCTION.pack()))
        self.assertEqual((auction, auction and auction.digest), (AUCTION, AUCTION.digest))
        for one in (bid(3, 2.5), bid(3, 0), bid(3, None, 4)):
            there = parse_bid(sent(one.pack()))
            self.assertEqual((there, there and there.is_genuine(AUCTION)), (one, True))
        said = announced(3, 1, bid(4, 1.5), bid(5, 2.5, 2))
        heard = parse_announcement(sent(said.pack()))
        self.assertEqual((heard, heard and heard.is_genuine(AUCTION)), (said, True))


class AuctionTests(SynchronousTestCase):
    def test_council_is_part_of_it(self) -> None:
        """An auction with a different council, epoch, strategy or waiting period has a different digest."""
        others = [
            replace(AUCTION, council=COUNCIL[:2]),
            replace(AUCTION, epoch=2),
            replace(AUCTION, strategy="cbba"),
            replace(AUCTION, waiting_period=9.0),
            replace(AUCTION, exclusive=False),
        ]
        self.assertEqual(len({each.digest for each in [AUCTION, *others]}), 6)

    def test_unlawful_ones(self) -> None:
        """An auction with an invalid council, epoch, strategy or waiting period is rejected by the decoder."""
        lawful = AUCTION.pack()
        for place, wrong in ((0, ""), (0, 7), (1, -1), (2, []), (2, [CONTACTS[0].pack()] * 2), (3, "x" * 65)):
            self.assertIsNone(parse_auction([*lawful[:place], wrong, *lawful[place + 1 :]]), wrong)
        for waiting in (math.nan, math.inf, -1.0, 1e9):
            self.assertIsNone(parse_auction([*lawful[:4], waiting, True]), waiting)

    @given(anything)
    @settings(max_examples=60, deadline=None)
    def test_decoders_are_total(self, content: Any) -> None:
        """For any input a decoder returns a valid object or None, and never raises."""
        auction, one, announcement = parse_auction(content), parse_bid(content), parse_announcement(content)
        for shaped in ([AUCTION.pack()[:2] + [content] * 4], [AGENTS[0].public, content, 0, b"s" * 64]):
            parse_auction(shaped)
            parse_bid(shaped)
        parse_announcement([1, 0, content, b"s" * 64])
        parse_announcement([1, 0, [["a" * 40, content, 0]], b"s" * 64])
        self.assertTrue(auction is None or isinstance(auction, Auction))
        self.assertEqual((one, announcement), (None, None))


class BidTests(SynchronousTestCase):
    def test_forged_ones(self) -> None:
        """A bid is not genuine if its cost, revision, key or auction differs from the signed bid."""
        one = bid(3, 2.5)
        assert one.report is not None
        forged = [
            replace(one, report=replace(one.report, cost=0.1)),
            replace(one, report=None),
            replace(one, revision=1),
            replace(one, public=AGENTS[4].public),
        ]
        for each in forged:
            self.assertFalse(each.is_genuine(AUCTION))
        self.assertFalse(one.is_genuine(replace(AUCTION, epoch=2)))

    def test_costs_that_are_none(self) -> None:
        """NaN, infinite, negative and huge costs, and unknown fields, give no report."""
        for cost in (math.nan, math.inf, -math.inf, -1.0, 1e300, True, "1", None):
            self.assertIsNone(parse_report({"cost": cost}, "a"), cost)
        self.assertIsNone(parse_report({"cost": 1.0, "friend": "b"}, "a"))
        self.assertIsNone(parse_report({"cost": 1.0, "agent": "b"}, "a"))


class AnnouncementTests(SynchronousTestCase):
    def test_only_of_the_council(self) -> None:
        """If a node outside the council signed an announcement, it is not genuine, whatever rank it contains."""
        stranger = AGENTS[7]
        one = announced(1, 0, bid(4, 1.5))
        for rank in (0, 1, 2, 3, 99):
            forged = replace(one, rank=rank).sign(stranger.sign, AUCTION)
            self.assertFalse(forged.is_genuine(AUCTION), rank)

    def test_forged_ones(self) -> None:
        """An announcement is not genuine if its number, rank, winner or auction differs from the signed one."""
        one = announced(1, 0, bid(4, 1.5))
        other = announced(1, 0, bid(5, 1.5))
        for forged in (replace(one, number=2), replace(one, rank=1), replace(one, entries=other.entries)):
            self.assertFalse(forged.is_genuine(AUCTION))
        self.assertFalse(one.is_genuine(replace(AUCTION, epoch=2)))

    def test_doubled_agents(self) -> None:
        """An announcement with two reports of one agent is rejected by the decoder."""
        one = announced(1, 0, bid(4, 1.5), bid(4, 2.5))
        self.assertIsNone(parse_announcement(sent(one.pack())))

    def test_precedence(self) -> None:
        """The announcement with the higher number has precedence, or the lower rank if the numbers are equal."""
        first, second, third = announced(1, 0), announced(1, 2), announced(2, 2)
        self.assertEqual(sorted([first, third, second], key=lambda a: a.precedence), [second, first, third])
