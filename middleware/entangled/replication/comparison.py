"""The records that this node and a peer should both store: digests of groups, lists of slots, and pages of records.

Answers DIGESTS, PLACES, FETCH and LACKING; ``handover`` sends these requests.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.contact import Contact
from middleware.entangled.errors import Refused
from middleware.entangled.kademlia.overlay import Overlay
from middleware.entangled.record import Record, Slot, parse_slot
from middleware.entangled.replication.replica import PAGE_BYTES, Replica
from middleware.entangled.replication.sync_state import CURRENT, NEVER_SYNCED
from middleware.entangled.replication.watch import digest_of
from middleware.entangled.wire.endpoint import Endpoint

GROUPS = 16
"""The number of groups into which the id space is divided.  Each group has a digest, so if one group differs, only its
slots are compared."""
PAGE_RECORDS = 12
"""The maximum number of slots or records in one message."""
SNAPSHOT_S = 2.0
"""Seconds for which a snapshot of the slots is stored for a peer after its request for digests."""
MAX_SNAPSHOTS = 8
MAX_PEERS = 1024
"""The number of peers whose last request is remembered; the oldest is dropped first."""
SIGNATURE_BITS = 512
"""The number of bits of a signature.  The requester chooses a random bit; a sum of lifetimes includes only the records
with this bit set in their signature."""

Mark = tuple[int, bytes]
"""Version of a slot: the record's sequence and the first bytes of its signature; (-1, b"") if empty."""


class Comparison:
    """The team records of one node as its peers see them.

    ``requested_at`` maps peers to the time of their last request for digests; ``get_sync_state`` returns this node's
    sync state.
    """

    def __init__(self, replica: Replica, overlay: Overlay, endpoint: Endpoint, clock: IReactorTime) -> None:
        self.requested_at: dict[bytes, float] = {}
        self.get_sync_state: Callable[[], int] = lambda: CURRENT
        self._replica = replica
        self._overlay = overlay
        self._clock = clock
        self._own_id = overlay.own_id
        self._snapshots: dict[bytes, tuple[float, list[list[Record]]]] = {}
        self._responsible: dict[bytes, list[bytes]] = {}
        self._members_version = -1
        endpoint.expose("digests", self._answer_digests)
        endpoint.expose("places", self._answer_places)
        endpoint.expose("fetch", self._answer_fetch)
        endpoint.expose("lacking", self._answer_lacking)

    def find_shared(self, peer: Contact) -> tuple[list[list[Record]], list[Record]]:
        """Return the records that both nodes should store, by groups, and those that only the peer should store."""
        groups: list[list[Record]] = [[] for _ in range(GROUPS)]
        extra = []
        if self._members_version != self._overlay.members.version or not self._overlay.is_complete:
            self._responsible.clear()
            self._members_version = self._overlay.members.version
        for record in self._replica.team_records():
            ids = self._responsible.get(record.key)
            if ids is None:
                ids = self._responsible[record.key] = [c.node_id for c in self._overlay.find_responsible(record.key)]
            is_mine, is_theirs = self._own_id in ids, peer.node_id in ids
            if is_theirs and is_mine:
                groups[record.key[0] * GROUPS >> 8].append(record)
            elif is_theirs:
                extra.append(record)
        return groups, extra

    def sum_lifetimes(self, group: list[Record], bit: int) -> int:
        """Return the sum of the remaining whole seconds of the records in ``group`` with ``bit`` set in the signature.

        The owner does not sign the remaining lifetime, so the digest does not contain it.  A malicious node that
        reported a short lifetime to one replica could compensate this in a sum over all records with records of its
        own, but not in a sum over a random subset.
        """
        byte, mask = bit >> 3, 1 << (bit & 7)
        return sum(
            int(self._replica.remaining_lifetime(r))
            for r in group
            if len(r.signature) > byte and r.signature[byte] & mask
        )

    # -- requests of peers ---------------------------------------------------------------------------------------------

    def _answer_digests(self, peer: Contact, bit: int, sync_state: int) -> list[object]:
        """Answer DIGESTS: return each group's digest and sum of lifetimes, and the number of records for the peer only.

        The two nodes also exchange their sync states.
        """
        if not 0 <= bit < SIGNATURE_BITS:
            raise Refused(f"the bit of a signature must be from 0 to {SIGNATURE_BITS - 1}")
        *groups, extra = self._make_snapshot(peer)
        self.requested_at.pop(peer.node_id, None)
        self.requested_at[peer.node_id] = self._clock.seconds()
        if len(self.requested_at) > MAX_PEERS:
            del self.requested_at[next(iter(self.requested_at))]
        self._overlay.members.set_voter(peer.node_id, sync_state > NEVER_SYNCED)
        lives = [self.sum_lifetimes(group, bit) for group in groups]
        return [[digest_of(group) for group in groups], len(extra), lives, self.get_sync_state()]

    def _answer_places(self, peer: Contact, group: int, after: list[object]) -> list[object]:
        """Answer PLACES: return a sorted page of slots with marks in one group.

        The group -1 contains the records that only the peer should store.
        """
        if not -1 <= group < GROUPS:
            raise Refused(f"the group must be a number from -1 to {GROUPS - 1}")
        cursor = parse_slot(after)
        if after and cursor is None:
            raise Refused("the start of a page must be empty or a key, an owner and a name")
        listed_at, lists = self._snapshots.get(peer.node_id, (-SNAPSHOT_S, []))
        if self._clock.seconds() - listed_at >= SNAPSHOT_S:
            lists = self._make_snapshot(peer)
        records = lists[group]
        begin = bisect_right(records, cursor, key=lambda record: record.slot) if cursor else 0
        return [
            [*record.slot, record.sequence, record.signature[:8], int(self._replica.remaining_lifetime(record))]
            for record in records[begin : begin + PAGE_RECORDS]
        ]

    def _answer_fetch(self, peer: Contact, slots: list[object]) -> list[object]:
        """Answer FETCH: return the record in each slot and its remaining seconds, or None, up to one page."""
        page: list[object] = []
        size = 0
        for place in slots[:PAGE_RECORDS]:
            slot = parse_slot(place)
            if slot is None:
                raise Refused("a slot must consist of a key, an owner and a name")
            record = self._replica.get_visible(slot)
            size += 0 if record is None else record.message_bytes
            if page and size > PAGE_BYTES:
                break
            page.append(None if record is None else [record.pack(), self._replica.remaining_lifetime(record)])
        return page

    def _answer_lacking(self, peer: Contact, places: list[object]) -> list[bool]:
        """Answer LACKING: return for each given slot and mark whether that record is newer than the local record."""
        answer = []
        for place in places[:PAGE_RECORDS]:
            if not (isinstance(place, list) and [type(part) for part in place] == [bytes, bytes, str, int, bytes]):
                raise Refused(
                    "an item must consist of a key, an owner, a name, a number and the first bytes of a signature"
                )
            answer.append((place[3], place[4]) > mark_of(self._replica.get_visible(Slot(*place[:3]))))
        return answer

    # -- inside -----------------------------------------------------------------------------------------------------

    def _make_snapshot(self, peer: Contact) -> list[list[Record]]:
        """Return ``find_shared`` as sorted lists, and store them as the snapshot for ``peer``.

        The last list contains the records that only the peer should store.
        """
        groups, extra = self.find_shared(peer)
        lists = [sorted(records, key=lambda record: record.slot) for records in (*groups, extra)]
        now = self._clock.seconds()
        self._snapshots.pop(peer.node_id, None)
        for other, (at, _) in list(self._snapshots.items()):
            if now - at >= SNAPSHOT_S or len(self._snapshots) >= MAX_SNAPSHOTS:
                del self._snapshots[other]  # because snapshots keep replaced records in memory
        self._snapshots[peer.node_id] = (now, lists)
        return lists


def mark_of(record: Record | None) -> Mark:
    """Return the version mark of ``record``; a newer record has a higher mark."""
    return (-1, b"") if record is None else (record.sequence, record.signature[:8])
