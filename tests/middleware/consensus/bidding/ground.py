"""Provide auctions, agents and bids that the tests of bidding share."""

from __future__ import annotations

import random

from middleware.consensus.bidding.announcement import AnnouncedReport, Announcement
from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.bid import Bid
from middleware.consensus.bidding.merge_rule import MergeRule
from middleware.consensus.bidding.participant import OnSummary, Participant
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Report
from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address

AGENTS = [Identity(bytes([place]) * 32) for place in range(1, 13)]
CONTACTS = [Contact(agent.public, Address("10.0.0.1", 7000 + place)) for place, agent in enumerate(AGENTS)]
COUNCIL = tuple(CONTACTS[:3])
AUCTION = Auction("job", 1, COUNCIL)
BEST_EFFORT = Auction("job", 1, COUNCIL, exclusive=False)


def bid(place: int, cost: float | None, revision: int = 0, auction: Auction = AUCTION) -> Bid:
    """Return the signed bid of the agent with index ``place``."""
    agent = AGENTS[place]
    report = None if cost is None else Report(agent.node_id.hex(), cost)
    return Bid(agent.public, report, revision).sign(agent, auction)


def announced(number: int, rank: int, *bids: Bid, auction: Auction = AUCTION) -> Announcement:
    """Return an announcement that the council member with this rank signed."""
    entries = tuple(AnnouncedReport(b.report, b.revision) for b in bids if b.report is not None)
    return Announcement(number, rank, entries).sign(AGENTS[rank].sign, auction)


def rule() -> MergeRule:
    """Return the rule of the strategy ``Nearest``."""
    return MergeRule(Nearest())


def make_participant(
    place: int, auction: Auction = AUCTION, seed: int = 1, on_summary: OnSummary = lambda reports: None
) -> Participant:
    """Return the participant of the node with index ``place``; this node knows all other nodes."""
    others = [contact for contact in CONTACTS if contact is not CONTACTS[place]]
    dice = random.Random(f"{seed}/{place}")
    return Participant(auction, CONTACTS[place], rule(), lambda: others, dice, AGENTS[place].sign, on_summary)
