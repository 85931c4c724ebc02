"""Flood bids from neighbour to neighbour if no quorum member is reachable; pure.

Only the bids for tasks without an exclusive lease are flooded.  Messages are not acknowledged; lost messages do no harm
because each node has about eight neighbours.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable

from middleware.consensus.bidding.bid import Bid
from middleware.consensus.bidding.merge_rule import MergeRule
from middleware.consensus.bidding.outgoing_message import FloodedBids
from middleware.consensus.bidding.summary import Summary
from middleware.entangled.contact import Contact
from middleware.entangled.kademlia.distance import select_closest

MAX_NEIGHBOURS = 8
NEAREST_NEIGHBOURS = 4
"""Number of neighbours that are the nearest nodes by id, so that every part of the key space is reached."""


class Flood:
    """The flooded bids at one node, and their forwarding."""

    def __init__(
        self, own_id: bytes, rule: MergeRule, contacts: Callable[[], Iterable[Contact]], rng: random.Random
    ) -> None:
        self.summary = Summary(rule)
        self._own_id = own_id
        self._contacts = contacts
        self._rng = rng
        self._neighbours: list[Contact] = []
        self._senders: dict[bytes, Contact] = {}
        self._is_changed = False

    def join(self, bids: Iterable[Bid], sender: Contact | None = None) -> bool:
        """Add bids of ``sender`` (None: the node's own bid); return whether the summary has changed."""
        changed = self.summary.join(bids)
        if sender is not None and len(self._senders) < MAX_NEIGHBOURS:
            self._senders.setdefault(sender.node_id, sender)
        self._is_changed = self._is_changed or changed
        return changed

    def take_due_messages(self) -> list[FloodedBids]:
        """Return the messages that are due now: one per neighbour if there was a change."""
        if not self._is_changed:
            return []
        self._is_changed = False
        return [FloodedBids(neighbour, self.summary.list_bids()) for neighbour in self._choose_neighbours()]

    def _choose_neighbours(self) -> list[Contact]:
        """Return the neighbours: the nearest nodes, random nodes, and nodes that sent flooded bids to this node."""
        if not self._neighbours:
            known = list(self._contacts())
            near = select_closest(known, self._own_id, NEAREST_NEIGHBOURS)
            far = [contact for contact in known if contact not in near]
            self._neighbours = near + self._rng.sample(far, min(len(far), MAX_NEIGHBOURS - len(near)))
        once = {contact.node_id: contact for contact in self._neighbours}
        for node_id, contact in self._senders.items():
            if len(once) < MAX_NEIGHBOURS:
                once.setdefault(node_id, contact)
        return list(once.values())
