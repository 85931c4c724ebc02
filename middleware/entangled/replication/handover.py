"""Transfer of records between replicas as nodes join, leave and return (anti-entropy).

Two nodes *reconcile* their records: they compare digests of the records that both should store, then the slots of the
groups that differ, and each node sends the newer records to the other.  A node reconciles with each new node, and
periodically with a random node.  A node that is new or was absent is not *synced* until it has reconciled with a
majority.  Until then its replies are not counted in majorities.  When a node is lost, its records are sent to the next
closest node.
"""

from __future__ import annotations

import random
from contextlib import suppress
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background, gather_first
from middleware.entangled.contact import Contact
from middleware.entangled.data.store import Store
from middleware.entangled.errors import EntangledError, Refused
from middleware.entangled.kademlia.distance import distance
from middleware.entangled.kademlia.member_table import ABSENT_WITH_MAJORITY_S
from middleware.entangled.kademlia.overlay import K, Overlay
from middleware.entangled.record import Record, Slot, parse_record, parse_slot
from middleware.entangled.replication.comparison import GROUPS, PAGE_RECORDS, SIGNATURE_BITS, Comparison, Mark, mark_of
from middleware.entangled.replication.owner import REPUBLISH_INTERVAL_S, Owner
from middleware.entangled.replication.replica import Replica, split_pages
from middleware.entangled.replication.sync_state import CURRENT, NEVER_SYNCED, STALE, SyncState
from middleware.entangled.replication.watch import digest_of
from middleware.entangled.wire.endpoint import Endpoint

FIRST_REPLICAS = 2
RECONCILE_INTERVAL_S = 10.0
MAX_SILENCE_S = ABSENT_WITH_MAJORITY_S / 2
"""Seconds without contact to a majority after which this node is no longer synced, because the other nodes may have
removed it from the voters."""
CHECK_INTERVAL_S = 1.0
LIFETIME_SLACK_S = 60.0
"""Seconds by which the remaining lifetime at another replica must exceed the local remaining lifetime to extend it.
The slack is needed because the time of a transfer, which may be seconds, is not subtracted from the lifetime."""
LIFETIME_SUM_SLACK_S = 1800
"""If the sums of lifetimes of a group differ by more than this number of seconds, the slots of the group are
compared."""
CONTACTS_INTERVAL_S = 0.1
NEW_NODE_DELAY_S = 1.0
"""Seconds for which a new node may catch up by itself, before this node reconciles with it.  The delay is random, up to
twice this value."""


class Handover:
    """Reconciles the team records of one node with the other replicas."""

    def __init__(
        self,
        store: Store,
        replica: Replica,
        overlay: Overlay,
        owner: Owner,
        endpoint: Endpoint,
        clock: IReactorTime,
        rng: random.Random,
        background: Background,
    ) -> None:
        self._replica = replica
        self._overlay = overlay
        self._owner = owner
        self._clock = clock
        self._rng = rng
        self._background = background
        self._own_id = overlay.own_id
        self._contact_at = clock.seconds()
        self._sync_state = SyncState(store)
        self._reconciled_at: dict[bytes, float] = {}
        self._sync_states: dict[bytes, int] = {}
        self._reconciling: set[bytes] = set()
        self._is_catching_up = False
        self._stored_at: dict[Slot, float] = {}
        self._sent_digests: dict[bytes, bytes] = {}
        self._comparison = Comparison(replica, overlay, endpoint, clock)
        self._comparison.get_sync_state = self._current_sync_state
        endpoint.expose("settled", self._answer_settled, changes=True, idempotent=True)

    def start(self, forgot: bool = False) -> None:
        """Start the periodic reconciliation, and the check for contact to a majority.

        ``forgot`` is true if the node dropped the records from before its restart, although other nodes may rely on
        them.
        """
        self._sync_state.start(forgot)
        self._overlay.members.is_voter = self._sync_state.value != NEVER_SYNCED
        self._contact_at = self._clock.seconds()
        self._background.every(RECONCILE_INTERVAL_S, self._reconcile_random)
        self._background.every(CHECK_INTERVAL_S, self._check_contact)

    def is_synced(self) -> bool:
        """Return whether this node has caught up with the other nodes, and has stayed in contact with a majority."""
        if self._sync_state.is_synced and self._clock.seconds() - self._contact_at > MAX_SILENCE_S:
            self._lose_sync()
        return self._sync_state.is_synced

    def start_catch_up(self) -> None:
        """Catch up with the other nodes after the join; a node alone in its network is synced immediately."""
        if not len(self._overlay.members) and not self._overlay.members.list_absent():
            self._become_synced()
        else:
            self._background.fork(self._catch_up())

    def handle_new_contact(self, contact: Contact) -> None:
        """Reconcile with a new node after a delay, unless the new node has reconciled with this node by then."""
        if self._is_near(contact):
            self._background.later(
                NEW_NODE_DELAY_S * (1 + self._rng.random()), self._reconcile_if_new, contact, self._clock.seconds()
            )

    def handle_lost_contact(self, contact: Contact) -> None:
        """Send the records of a lost node to the nodes that are now among the closest to the keys of these records."""
        self._reconciled_at.pop(contact.node_id, None)
        self._comparison.requested_at.pop(contact.node_id, None)
        self._sent_digests.pop(contact.node_id, None)
        self._sync_states.pop(contact.node_id, None)
        successors: dict[bytes, tuple[Contact, list[Record]]] = {}
        for record in self._replica.team_records():
            nearest = self._overlay.find_responsible(record.key)
            if len(nearest) < K or all(c.node_id != self._own_id for c in nearest[:FIRST_REPLICAS]):
                continue
            successor = nearest[-1]
            was_closer = distance(contact.node_id, record.key) < distance(successor.node_id, record.key)
            if was_closer and successor.node_id != self._own_id:
                successors.setdefault(successor.node_id, (successor, []))[1].append(record)
        for successor, records in successors.values():
            self._background.fork(self._send_all(successor, records))

    def record_republication(self, record: Record) -> None:
        """Note that another node has just republished ``record``, so this node need not republish it."""
        self._stored_at[record.slot] = self._clock.seconds()

    # -- inside -----------------------------------------------------------------------------------------------------

    def _reconcile_if_new(self, contact: Contact, since: float) -> None:
        compared_at = max(
            self._reconciled_at.get(contact.node_id, -1.0), self._comparison.requested_at.get(contact.node_id, -1.0)
        )
        if compared_at < since:
            self._background.fork(self._reconcile(contact))

    def _is_near(self, contact: Contact) -> bool:
        """Return whether this node and ``contact`` may be replicas of the same keys."""
        return self._overlay.is_complete or contact in self._near_nodes()

    def _near_nodes(self) -> list[Contact]:
        """Return the nodes that may be replicas of the same keys as this node."""
        return self._overlay.members.list_live() if self._overlay.is_complete else self._overlay.find_neighbours()

    async def _reconcile(self, contact: Contact) -> None:
        """Exchange records with ``contact``, so that neither node lacks a record that both should store."""
        if contact.node_id in self._reconciling:
            return
        self._reconciling.add(contact.node_id)
        try:
            began = self._clock.seconds()
            bit = self._rng.randrange(SIGNATURE_BITS)
            answer = await self._overlay.ask(
                contact, "digests", bit, self._current_sync_state(), is_light=self._overlay.is_large
            )
            digests, extra, lives, sync_state = (
                answer if isinstance(answer, list) and len(answer) == 4 else ([], 0, [], 0)
            )
            own, for_peer = self._comparison.find_shared(contact)
            if not (_is_list_of(digests, bytes) and _is_list_of(lives, int)):
                raise Refused(f"{contact.address} sent an invalid answer to the request 'digests'")
            for group, (digest, life) in enumerate(zip(digests, lives, strict=True)):
                is_longer = life > self._comparison.sum_lifetimes(own[group], bit) + LIFETIME_SUM_SLACK_S
                if is_longer or digest != digest_of(own[group]):
                    await self._compare_group(contact, group, own[group])
            if extra:
                await self._compare_group(contact, -1, [])
            await self._send_lacking(contact, for_peer)
            self._reconciled_at[contact.node_id] = began
            self._sync_states[contact.node_id] = sync_state if sync_state in (STALE, CURRENT) else NEVER_SYNCED
            self._overlay.members.set_voter(contact.node_id, sync_state in (STALE, CURRENT))
        finally:
            self._reconciling.discard(contact.node_id)

    async def _compare_group(self, contact: Contact, group: int, own: list[Record]) -> None:
        theirs: dict[Slot, Mark] = {}
        after: Slot | None = None
        while True:
            answer = await self._overlay.ask(contact, "places", group, [] if after is None else list(after))
            places = (
                [place for place in map(_parse_entry, answer) if place is not None] if isinstance(answer, list) else []
            )
            for slot, mark, left in places:
                theirs[slot] = mark
                self._extend_life(slot, mark, left)
            if len(places) < PAGE_RECORDS or (after is not None and places[-1][0] <= after):
                break
            after = places[-1][0]
        wanted = [slot for slot, mark in theirs.items() if mark > mark_of(self._replica.get_visible(slot))]
        await self._fetch(contact, wanted)
        newer = [record for record in own if mark_of(record) > theirs.get(record.slot, (-1, b""))]
        await self._send_all(contact, newer)

    def _extend_life(self, slot: Slot, mark: Mark, left: float) -> None:
        """Extend the lifetime of the record in ``slot`` to ``left`` seconds, if it has this mark and expires earlier.

        The longest lifetime that any replica reports is used; a shorter lifetime has no effect.
        """
        record = self._replica.get_visible(slot)
        if record is None or record.lifetime != "team" or mark_of(record) != mark:
            return
        if min(left, record.ttl) > self._replica.remaining_lifetime(record) + LIFETIME_SLACK_S:
            self._replica.store_locally(record, left)

    async def _fetch(self, contact: Contact, wanted: list[Slot]) -> None:
        """Fetch the records in ``wanted`` slots from ``contact``, page by page."""
        while wanted:
            answer = await self._overlay.ask(contact, "fetch", [list(slot) for slot in wanted[:PAGE_RECORDS]])
            page = answer if isinstance(answer, list) else []
            await self._replica.certificates.fetch_missing(contact, (slot.owner for slot in wanted[: len(page)]))
            for slot, fields in zip(wanted, page, strict=False):
                self._store_fetched(slot, fields)
            wanted = wanted[len(page) :] if page else []

    def _store_fetched(self, slot: Slot, found: object) -> None:
        """Store a fetched record if it is valid and supersedes the local record."""
        fields, left = found if isinstance(found, list) and len(found) == 2 else (None, None)
        record = parse_record(fields)
        if record is None or record.slot != slot or type(left) is not float or record.lifetime != "team":
            return
        if record.supersedes(self._replica.get_visible(slot)) and self._replica.is_genuine(record):
            self._replica.store_locally(record, left)

    async def _send_lacking(self, contact: Contact, records: list[Record]) -> None:
        """Send ``contact`` the ``records`` that it lacks; only ``contact`` should store them, not this node.

        Once ``contact`` has all these records, this node contacts it again about them only when their set changes.
        """
        digest = digest_of(records)
        if not records or self._sent_digests.get(contact.node_id) == digest:
            return
        for begin in range(0, len(records), PAGE_RECORDS):
            page = records[begin : begin + PAGE_RECORDS]
            places = [[*record.slot, *mark_of(record)] for record in page]
            answer = await self._overlay.ask(contact, "lacking", places)
            if not (isinstance(answer, list) and len(answer) == len(page)):
                raise Refused(f"{contact.address} sent an invalid answer to the request 'lacking'")
            await self._send_all(contact, [record for record, lacks in zip(page, answer, strict=True) if lacks])
        self._sent_digests[contact.node_id] = digest

    async def _send_all(self, contact: Contact, records: list[Record]) -> None:
        """Store ``records`` at ``contact``, page by page; ignore rejections, for example because its store is full."""
        for page in split_pages(records, PAGE_RECORDS):
            lives = [self._replica.remaining_lifetime(record) for record in page]
            with suppress(Refused):
                await self._overlay.ask(contact, "store", [r.pack() for r in page], lives, changes=True)

    async def _catch_up(self) -> None:
        """Reconcile with as many near nodes as guarantee that no acknowledged record is missing."""
        if self._is_catching_up:
            return
        self._is_catching_up = True
        try:
            while not self._sync_state.is_synced and not self._background.is_stopped:
                if not self._overlay.is_complete and len(self._overlay.table) < K:
                    await self._background.sleep(CONTACTS_INTERVAL_S)  # too few contacts are known yet
                    continue
                began = self._clock.seconds()
                others = self._near_nodes()
                # Most records come from the first nodes; the nodes after them then need not send these records again.
                reached = [await self._try_reconcile(contact) for contact in others[:FIRST_REPLICAS]]
                work = [Deferred.fromCoroutine(self._try_reconcile(contact)) for contact in others[FIRST_REPLICAS:]]
                reached += [await each for each in work]
                away = len(self._overlay.members.list_absent()) if self._overlay.is_complete else 0
                if self._sync_state.is_enough(reached, away) and self._contact_at >= began - MAX_SILENCE_S:
                    self._become_synced()
                    return
                await self._background.sleep(CHECK_INTERVAL_S)
        finally:
            self._is_catching_up = False

    async def _try_reconcile(self, contact: Contact) -> int | None:
        """Reconcile with ``contact``; return its sync state, None on failure."""
        try:
            await self._reconcile(contact)
        except EntangledError:
            return None
        return self._sync_states[contact.node_id] if self._reconciled_at.get(contact.node_id, -1.0) >= 0.0 else None

    def _current_sync_state(self) -> int:
        self.is_synced()
        return self._sync_state.value

    def _become_synced(self) -> None:
        """Mark this node as synced; the first time, announce this to the other nodes."""
        self._overlay.members.is_voter = True
        if self._sync_state.set_synced() and not self._overlay.is_large:
            for contact in self._overlay.members.list_live():
                self._background.fork(self._overlay.ask(contact, "settled", changes=True))

    def _answer_settled(self, peer: Contact) -> None:
        """Answer SETTLED: record that the peer has caught up for the first time and is now a voter."""
        self._overlay.members.set_voter(peer.node_id)

    def _lose_sync(self) -> None:
        self._sync_state.is_synced = False
        self._reconciled_at.clear()
        self._background.fork(self._catch_up())

    def _check_contact(self) -> None:
        now = self._clock.seconds()
        was_synced = self.is_synced()
        if not self._overlay.is_complete or self._overlay.members.is_majority_alive(now, MAX_SILENCE_S):
            self._contact_at = now
        if not was_synced and not self._is_catching_up:
            self._background.fork(self._catch_up())

    def _reconcile_random(self) -> None:
        """Reconcile with a random node, and republish the records that no other node republished."""
        others = self._near_nodes()
        if others:
            self._background.fork(self._reconcile(others[self._rng.randrange(len(others))]))
        now = self._clock.seconds()
        records = self._replica.team_records()
        slots = {record.slot for record in records}
        self._stored_at = {slot: at for slot, at in self._stored_at.items() if slot in slots}
        for record in records:
            # Replicas republish at random times, so that one replica republishes and the other replicas notice it.
            due = (
                self._stored_at.setdefault(record.slot, now - self._rng.random() * REPUBLISH_INTERVAL_S / 2)
                + REPUBLISH_INTERVAL_S
            )
            if now > due and not self._owner.owns(record.slot):
                self._stored_at[record.slot] = now
                self._background.fork(self._republish(record))

    async def _republish(self, record: Record) -> Any:
        targets = await self._overlay.lookup_replicas(record.key)
        others = [contact for contact in targets if contact.node_id != self._own_id]
        left = self._replica.remaining_lifetime(record)
        return await gather_first(len(targets), [self._owner.store_at(contact, record, left) for contact in others])


def _is_list_of(parts: object, kind: type) -> bool:
    return isinstance(parts, list) and len(parts) == GROUPS and all(type(part) is kind for part in parts)


def _parse_entry(fields: object) -> tuple[Slot, Mark, float] | None:
    """Parse an item of an answer to PLACES: slot, mark and remaining seconds; None if it is malformed."""
    if not isinstance(fields, list) or [type(part) for part in fields[3:]] != [int, bytes, int]:
        return None
    slot = parse_slot(fields[:3])
    return None if slot is None else (slot, (fields[3], fields[4]), float(fields[5]))
