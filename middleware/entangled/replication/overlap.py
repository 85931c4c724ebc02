"""Overlap: what this node holds and a peer should hold, too: in parts with a digest each, listed and given in pages.

It answers DIGESTS, PLACES, FETCH and LACKING; who compares with whom, and when, stands in ``handover``.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.contact import Contact
from middleware.entangled.errors import Refused
from middleware.entangled.kademlia.overlay import Overlay
from middleware.entangled.record import Record, Slot, slot_unpacked
from middleware.entangled.replication.replica import PAGE_BYTES, Replica
from middleware.entangled.replication.standing import NOVICE, SURE
from middleware.entangled.replication.watch import digest_of
from middleware.entangled.wire.endpoint import Endpoint

GROUPS = 16
"""Parts of the id space with a digest each, so that one difference does not mean to compare everything."""
PLACES = 12
"""Places, and records, in one message."""
LISTED_S = 2.0
"""Seconds for which who pages through the places gets to see them as they were when it asked for the digests."""
MAX_LISTED = 8
MAX_ASKED = 1024
"""Peers of which is kept when they asked; the one that asked longest ago is forgotten first."""
BITS = 512
"""Bits of a signature: one of them, which the asker draws, says which records are in a sum of lives."""

Mark = tuple[int, bytes]
"""Which record a slot holds: its sequence and the first bytes of its signature; (-1, b"") where it holds none."""


class Overlap:
    """The team records of one node, as seen by its peers; ``asked_at`` is when each of them last asked for digests.

    ``standing`` says that of this node.
    """

    def __init__(self, replica: Replica, overlay: Overlay, endpoint: Endpoint, clock: IReactorTime) -> None:
        self.asked_at: dict[bytes, float] = {}
        self.standing: Callable[[], int] = lambda: SURE
        self._replica = replica
        self._overlay = overlay
        self._clock = clock
        self._own_id = overlay.own_id
        self._listed: dict[bytes, tuple[float, list[list[Record]]]] = {}
        self._near: dict[bytes, list[bytes]] = {}
        self._near_version = -1
        endpoint.expose("digests", self._answer_digests)
        endpoint.expose("places", self._answer_places)
        endpoint.expose("fetch", self._answer_fetch)
        endpoint.expose("lacking", self._answer_lacking)

    def both(self, peer: Contact) -> tuple[list[list[Record]], list[Record]]:
        """What is held here and should be at the peer as well: by parts, and what should not be here any more."""
        groups: list[list[Record]] = [[] for _ in range(GROUPS)]
        extra = []
        if self._near_version != self._overlay.roster.version or not self._overlay.is_complete:
            self._near.clear()
            self._near_version = self._overlay.roster.version
        for record in self._replica.team_records():
            ids = self._near.get(record.key)
            if ids is None:
                ids = self._near[record.key] = [c.node_id for c in self._overlay.responsible(record.key)]
            is_mine, is_theirs = self._own_id in ids, peer.node_id in ids
            if is_theirs and is_mine:
                groups[record.key[0] * GROUPS >> 8].append(record)
            elif is_theirs:
                extra.append(record)
        return groups, extra

    def life(self, group: list[Record], bit: int) -> int:
        """Whole seconds left to the records of ``group``, summed over those whose signature has that bit.

        What is left of a life is no owner's word, so the digest cannot have it.  Who named a short one to one holder
        could hide that in the sum of all by records of its own, but not in that of a part which it does not know.
        """
        byte, mask = bit >> 3, 1 << (bit & 7)
        return sum(int(self._replica.left(r)) for r in group if len(r.signature) > byte and r.signature[byte] & mask)

    # -- what peers ask ---------------------------------------------------------------------------------------------

    def _answer_digests(self, peer: Contact, bit: int, standing: int) -> list[object]:
        """DIGESTS: of each part of the id space, what both should hold; how much the peer alone should; the lives.

        The standings of both are told along with it.
        """
        if not 0 <= bit < BITS:
            raise Refused(f"a signature has the bits 0 to {BITS - 1}")
        *groups, extra = self._lists(peer)
        self.asked_at.pop(peer.node_id, None)
        self.asked_at[peer.node_id] = self._clock.seconds()
        if len(self.asked_at) > MAX_ASKED:
            del self.asked_at[next(iter(self.asked_at))]
        self._overlay.roster.settle(peer.node_id, standing > NOVICE)
        lives = [self.life(group, bit) for group in groups]
        return [[digest_of(group) for group in groups], len(extra), lives, self.standing()]

    def _answer_places(self, peer: Contact, group: int, after: list[object]) -> list[object]:
        """PLACES: what is held here of a part of the id space (-1: of what only the peer should hold), in order."""
        if not -1 <= group < GROUPS:
            raise Refused(f"a group is a number from -1 to {GROUPS - 1}")
        cursor = slot_unpacked(after)
        if after and cursor is None:
            raise Refused("a page begins after a key, an owner and a name")
        listed_at, lists = self._listed.get(peer.node_id, (-LISTED_S, []))
        if self._clock.seconds() - listed_at >= LISTED_S:
            lists = self._lists(peer)
        records = lists[group]
        begin = bisect_right(records, cursor, key=lambda record: record.slot) if cursor else 0
        return [
            [*record.slot, record.sequence, record.signature[:8], int(self._replica.left(record))]
            for record in records[begin : begin + PLACES]
        ]

    def _answer_fetch(self, peer: Contact, slots: list[object]) -> list[object]:
        """FETCH: of each slot the record in it and the seconds left to that, or None; as many as make a page."""
        page: list[object] = []
        size = 0
        for place in slots[:PLACES]:
            slot = slot_unpacked(place)
            if slot is None:
                raise Refused("a slot is a key, an owner and a name")
            record = self._replica.shown(slot)
            size += 0 if record is None else record.message_bytes
            if page and size > PAGE_BYTES:
                break
            page.append(None if record is None else [record.packed(), self._replica.left(record)])
        return page

    def _answer_lacking(self, peer: Contact, places: list[object]) -> list[bool]:
        """LACKING: of each place whether the record in it is newer than what is held here."""
        answer = []
        for place in places[:PLACES]:
            if not (isinstance(place, list) and [type(part) for part in place] == [bytes, bytes, str, int, bytes]):
                raise Refused("a place is a key, an owner, a name, a number and a signature's first bytes")
            answer.append((place[3], place[4]) > mark_of(self._replica.shown(Slot(*place[:3]))))
        return answer

    # -- inside -----------------------------------------------------------------------------------------------------

    def _lists(self, peer: Contact) -> list[list[Record]]:
        """What both should hold, by parts, and last what only ``peer`` should: in order, and kept while it pages."""
        groups, extra = self.both(peer)
        lists = [sorted(records, key=lambda record: record.slot) for records in (*groups, extra)]
        now = self._clock.seconds()
        self._listed.pop(peer.node_id, None)
        for other, (at, _) in list(self._listed.items()):
            if now - at >= LISTED_S or len(self._listed) >= MAX_LISTED:
                del self._listed[other]  # it may hold what is replaced meanwhile
        self._listed[peer.node_id] = (now, lists)
        return lists


def mark_of(record: Record | None) -> Mark:
    """What tells ``record`` from others in its slot, and which of two is newer."""
    return (-1, b"") if record is None else (record.sequence, record.signature[:8])
