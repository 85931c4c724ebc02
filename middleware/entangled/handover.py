"""Handover: the team records of others, given on when nodes come and go, so that they outlive their writers.

Of the nodes that hold a record the two closest to its key see to it; what the newcomer has already costs one question.
"""

from __future__ import annotations

from collections.abc import Iterator

from middleware.entangled.background import Background
from middleware.entangled.errors import Refused
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.kademlia.distance import distance
from middleware.entangled.overlay import K, Overlay
from middleware.entangled.owner import Owner
from middleware.entangled.record import Record
from middleware.entangled.replica import Replica
from middleware.entangled.store import Store

STEWARDS = 2
MEND = 10.0
MENDED_AT_ONCE = 20
PAGE_BYTES = 2**16
"""Bytes of values that one question gives on; a larger value goes alone."""


class Handover:
    """What the node ``own_id`` gives on of what it holds for others."""

    def __init__(
        self, own_id: bytes, store: Store, replica: Replica, overlay: Overlay, owner: Owner, chores: Background
    ) -> None:
        self._own_id = own_id
        self._store = store
        self._replica = replica
        self._overlay = overlay
        self._owner = owner
        self._chores = chores
        self._mended = 0

    def start(self) -> None:
        """Look from time to time whether the records held here are held elsewhere as well."""
        self._chores.every(MEND, self._mend)

    def welcome(self, contact: Contact) -> None:
        """Give a newcomer the records that it is now among the closest to."""
        given = []
        for record in self._records():
            nearest = self._overlay.responsible(record.key)
            if _is_among(contact.node_id, nearest) and self._is_steward(nearest, without=contact.node_id):
                given.append(record)
        self._chores.fork(self._give(contact, given))

    def lost(self, contact: Contact) -> None:
        """Give the records that a lost contact held to the node that takes its place."""
        given: dict[bytes, tuple[Contact, list[Record]]] = {}
        for record in self._records():
            nearest = self._overlay.responsible(record.key)
            if len(nearest) < K or not self._is_steward(nearest):
                continue
            heir = nearest[-1]
            was_closer = distance(contact.node_id, record.key) < distance(heir.node_id, record.key)
            if was_closer and heir.node_id != self._own_id:
                given.setdefault(heir.node_id, (heir, []))[1].append(record)
        for heir, records in given.values():
            self._chores.fork(self._give(heir, records))

    # -- inside -----------------------------------------------------------------------------------------------------

    def _records(self) -> list[Record]:
        """The team records held here whose owners live elsewhere, or nowhere any more; tombstones included."""
        return [
            record
            for record in self._store.records()
            if record.lifetime == "team"
            and not self._owner.owns(record.slot)
            and record.slot not in self._replica.keepsakes
        ]

    async def _give(self, contact: Contact, records: list[Record]) -> None:
        """Store ``records`` at one node, page after page, so that never more than a page is on its way."""
        for page in _pages(records):
            try:
                await self._overlay.ask(contact, "store", [record.packed() for record in page], changes=True)
            except Refused:
                continue  # it has no room for one of them; perhaps it has for the others

    def _is_steward(self, nearest: list[Contact], without: bytes = b"") -> bool:
        return _is_among(self._own_id, [c for c in nearest if c.node_id != without][:STEWARDS])

    def _mend(self) -> None:
        records = self._records()
        page = next(_pages(records[self._mended : self._mended + MENDED_AT_ONCE]), [])
        for record in page:
            if self._overlay.responsible(record.key)[0].node_id == self._own_id:
                self._chores.fork(self._owner.store_everywhere(record))
        self._mended = self._mended + len(page) if self._mended + len(page) < len(records) else 0


def _pages(records: list[Record]) -> Iterator[list[Record]]:
    """``records`` in order, in pages of ``PAGE_BYTES``."""
    page: list[Record] = []
    size = 0
    for record in records:
        size += len(record.value or b"")
        if page and (size > PAGE_BYTES or len(page) == MENDED_AT_ONCE):
            yield page
            page, size = [], len(record.value or b"")
        page.append(record)
    if page:
        yield page


def _is_among(node_id: bytes, contacts: list[Contact]) -> bool:
    return any(c.node_id == node_id for c in contacts)
