"""Flood: bids go from neighbour to neighbour while no member of the council is in reach; pure.

For tasks that need no exclusive right.  Nothing is confirmed: eight ways to each node make up for what is lost.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable

from middleware.consensus.bidding.bid import Bid
from middleware.consensus.bidding.errand import Cry
from middleware.consensus.bidding.rule import Rule
from middleware.consensus.bidding.summary import Summary
from middleware.entangled.contact import Contact
from middleware.entangled.kademlia.distance import closest

NEIGHBOURS = 8
NEAREST = 4
"""Of these neighbours, how many are the nearest ones, so that no part of the ring of ids is left out."""


class Flood:
    """What one node cries out, and what it has heard."""

    def __init__(
        self, own_id: bytes, rule: Rule, contacts: Callable[[], Iterable[Contact]], rng: random.Random
    ) -> None:
        self.summary = Summary(rule)
        self._own_id = own_id
        self._contacts = contacts
        self._rng = rng
        self._neighbours: list[Contact] = []
        self._callers: dict[bytes, Contact] = {}
        self._cries = False

    def join(self, bids: Iterable[Bid], sender: Contact | None = None) -> bool:
        """Take bids in, the own one or what ``sender`` cried; whether they changed anything."""
        changed = self.summary.join(bids)
        if sender is not None and len(self._callers) < NEIGHBOURS:
            self._callers.setdefault(sender.node_id, sender)
        self._cries = self._cries or changed
        return changed

    def cries(self) -> list[Cry]:
        """What goes out now, to each neighbour once for each change."""
        if not self._cries:
            return []
        self._cries = False
        return [Cry(neighbour, self.summary.bids()) for neighbour in self._around()]

    def _around(self) -> list[Contact]:
        """The neighbours: the nearest, some anywhere, and those that count this node among theirs."""
        if not self._neighbours:
            known = list(self._contacts())
            near = closest(known, self._own_id, NEAREST)
            far = [contact for contact in known if contact not in near]
            self._neighbours = near + self._rng.sample(far, min(len(far), NEIGHBOURS - len(near)))
        once = {contact.node_id: contact for contact in self._neighbours}
        for node_id, contact in self._callers.items():
            if len(once) < NEIGHBOURS:
                once.setdefault(node_id, contact)
        return list(once.values())
