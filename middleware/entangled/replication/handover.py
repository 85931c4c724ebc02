"""Transfer of records between replicas as nodes join, leave and return (anti-entropy).

Two nodes *reconcile*: they compare digests of the records that both should hold, then the slots of parts that differ,
and each sends the other the newer records.  A node reconciles with each new node, and periodically with a random one.
A node that is new or was away is not *synced* until it has reconciled with a majority; until then its replies count in
no majority.  When a node is lost, its records are sent to the next closest node.
"""

from __future__ import annotations

import random
from contextlib import suppress
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background, first
from middleware.entangled.contact import Contact
from middleware.entangled.data.store import Store
from middleware.entangled.errors import EntangledError, Refused
from middleware.entangled.kademlia.distance import distance
from middleware.entangled.kademlia.overlay import K, Overlay
from middleware.entangled.kademlia.roster import STRUCK_S
from middleware.entangled.record import Record, Slot, slot_unpacked, unpacked
from middleware.entangled.replication.overlap import BITS, GROUPS, PLACES, Mark, Overlap, mark_of
from middleware.entangled.replication.owner import REPUBLISH, Owner
from middleware.entangled.replication.replica import Replica, pages_of
from middleware.entangled.replication.standing import ELDER, NOVICE, SURE, Standing
from middleware.entangled.replication.watch import digest_of
from middleware.entangled.wire.endpoint import Endpoint

FIRST_REPLICAS = 2
RECONCILE_INTERVAL_S = 10.0
OUT_OF_TOUCH = STRUCK_S / 2
"""Seconds without contact to a majority after which this node may have been removed, and is no longer synced."""
CHECK_INTERVAL_S = 1.0
LIFETIME_SLACK_S = 60.0
"""Seconds by which the remaining lifetime named by another replica must exceed the local one to extend it: a transfer
does not age a record, but may take seconds."""
LIFETIME_SUM_SLACK_S = 1800
"""Seconds by which the summed lifetimes of a part may differ before its slots are compared."""
CONTACTS_WAIT_S = 0.1
NEW_NODE_S = 1.0
"""Seconds that a new node gets to catch up by itself; up to twice as many, by random delay."""


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
        chores: Background,
    ) -> None:
        self._replica = replica
        self._overlay = overlay
        self._owner = owner
        self._clock = clock
        self._rng = rng
        self._chores = chores
        self._own_id = overlay.own_id
        self._contact_at = clock.seconds()
        self._standing = Standing(store)
        self._reconciled: dict[bytes, float] = {}
        self._standings: dict[bytes, int] = {}
        self._busy: set[bytes] = set()
        self._catching_up = False
        self._stored_at: dict[Slot, float] = {}
        self._sent_digests: dict[bytes, bytes] = {}
        self._overlap = Overlap(replica, overlay, endpoint, clock)
        self._overlap.standing = self._current_standing
        endpoint.expose("settled", self._answer_settled, changes=True, idempotent=True)

    def start(self, forgot: bool = False) -> None:
        """Start the periodic reconciliation, and the check for contact to a majority.

        ``forgot``: the node dropped the records of its earlier run, which other nodes may still count on.
        """
        self._standing.start(forgot)
        self._overlay.roster.is_settled = self._standing.now != NOVICE
        self._contact_at = self._clock.seconds()
        self._chores.every(RECONCILE_INTERVAL_S, self._reconcile_random)
        self._chores.every(CHECK_INTERVAL_S, self._check_contact)

    def is_sure(self) -> bool:
        """Return whether this node has caught up with the others and has been in contact with a majority since."""
        if self._standing.is_sure and self._clock.seconds() - self._contact_at > OUT_OF_TOUCH:
            self._lose_sync()
        return self._standing.is_sure

    def joined(self) -> None:
        """Catch up with the other nodes after the join; a node alone in its network is synced at once."""
        if not len(self._overlay.roster) and not self._overlay.roster.absent():
            self._become_synced()
        else:
            self._chores.fork(self._catch_up())

    def welcome(self, contact: Contact) -> None:
        """Reconcile with a new node after a delay, unless it has done so by itself."""
        if self._is_near(contact):
            self._chores.later(
                NEW_NODE_S * (1 + self._rng.random()), self._reconcile_if_new, contact, self._clock.seconds()
            )

    def lost(self, contact: Contact) -> None:
        """Send the records of a lost node to the node that is now among the closest to their keys."""
        self._reconciled.pop(contact.node_id, None)
        self._overlap.asked_at.pop(contact.node_id, None)
        self._sent_digests.pop(contact.node_id, None)
        self._standings.pop(contact.node_id, None)
        successors: dict[bytes, tuple[Contact, list[Record]]] = {}
        for record in self._replica.team_records():
            nearest = self._overlay.responsible(record.key)
            if len(nearest) < K or all(c.node_id != self._own_id for c in nearest[:FIRST_REPLICAS]):
                continue
            successor = nearest[-1]
            was_closer = distance(contact.node_id, record.key) < distance(successor.node_id, record.key)
            if was_closer and successor.node_id != self._own_id:
                successors.setdefault(successor.node_id, (successor, []))[1].append(record)
        for successor, records in successors.values():
            self._chores.fork(self._send_all(successor, records))

    def stored(self, record: Record) -> None:
        """Note that another node has just republished ``record``, so this node need not."""
        self._stored_at[record.slot] = self._clock.seconds()

    # -- inside -----------------------------------------------------------------------------------------------------

    def _reconcile_if_new(self, contact: Contact, since: float) -> None:
        compared_at = max(
            self._reconciled.get(contact.node_id, -1.0), self._overlap.asked_at.get(contact.node_id, -1.0)
        )
        if compared_at < since:
            self._chores.fork(self._reconcile(contact))

    def _is_near(self, contact: Contact) -> bool:
        """Return whether this node and ``contact`` may share records."""
        return self._overlay.is_complete or contact in self._near_nodes()

    def _near_nodes(self) -> list[Contact]:
        """Return the nodes that may share records with this one."""
        return self._overlay.roster.live() if self._overlay.is_complete else self._overlay.neighbours()

    async def _reconcile(self, contact: Contact) -> None:
        """Exchange with ``contact`` the records that either lacks."""
        if contact.node_id in self._busy:
            return
        self._busy.add(contact.node_id)
        try:
            began = self._clock.seconds()
            bit = self._rng.randrange(BITS)
            answer = await self._overlay.ask(
                contact, "digests", bit, self._current_standing(), is_light=self._overlay.is_large
            )
            digests, extra, lives, standing = (
                answer if isinstance(answer, list) and len(answer) == 4 else ([], 0, [], 0)
            )
            own, for_peer = self._overlap.both(contact)
            if not (_is_list_of(digests, bytes) and _is_list_of(lives, int)):
                raise Refused(f"{contact.address} sends an invalid reply to digests")
            for group, (digest, life) in enumerate(zip(digests, lives, strict=True)):
                is_longer = life > self._overlap.life(own[group], bit) + LIFETIME_SUM_SLACK_S
                if is_longer or digest != digest_of(own[group]):
                    await self._compare(contact, group, own[group])
            if extra:
                await self._compare(contact, -1, [])
            await self._send_lacking(contact, for_peer)
            self._reconciled[contact.node_id] = began
            self._standings[contact.node_id] = standing if standing in (ELDER, SURE) else NOVICE
            self._overlay.roster.settle(contact.node_id, standing in (ELDER, SURE))
        finally:
            self._busy.discard(contact.node_id)

    async def _compare(self, contact: Contact, group: int, own: list[Record]) -> None:
        theirs: dict[Slot, Mark] = {}
        after: Slot | None = None
        while True:
            answer = await self._overlay.ask(contact, "places", group, [] if after is None else list(after))
            places = (
                [place for place in map(_parse_place, answer) if place is not None] if isinstance(answer, list) else []
            )
            for slot, mark, left in places:
                theirs[slot] = mark
                self._extend_life(slot, mark, left)
            if len(places) < PLACES or (after is not None and places[-1][0] <= after):
                break
            after = places[-1][0]
        wanted = [slot for slot, mark in theirs.items() if mark > mark_of(self._replica.shown(slot))]
        await self._fetch(contact, wanted)
        newer = [record for record in own if mark_of(record) > theirs.get(record.slot, (-1, b""))]
        await self._send_all(contact, newer)

    def _extend_life(self, slot: Slot, mark: Mark, left: float) -> None:
        """Extend the life of the record in ``slot`` to ``left`` seconds, if it has this mark and expires earlier.

        The longest lifetime named by any replica wins; a short one ends nothing.
        """
        record = self._replica.shown(slot)
        if record is None or record.lifetime != "team" or mark_of(record) != mark:
            return
        if min(left, record.ttl) > self._replica.left(record) + LIFETIME_SLACK_S:
            self._replica.keep(record, left)

    async def _fetch(self, contact: Contact, wanted: list[Slot]) -> None:
        """Fetch the records in ``wanted`` slots from ``contact``, page by page."""
        while wanted:
            answer = await self._overlay.ask(contact, "fetch", [list(slot) for slot in wanted[:PLACES]])
            page = answer if isinstance(answer, list) else []
            await self._replica.certificates.learn(contact, (slot.owner for slot in wanted[: len(page)]))
            for slot, fields in zip(wanted, page, strict=False):
                self._store_fetched(slot, fields)
            wanted = wanted[len(page) :] if page else []

    def _store_fetched(self, slot: Slot, found: object) -> None:
        """Store a fetched record if it is valid and beats the local one."""
        fields, left = found if isinstance(found, list) and len(found) == 2 else (None, None)
        record = unpacked(fields)
        if record is None or record.slot != slot or type(left) is not float or record.lifetime != "team":
            return
        if record.beats(self._replica.shown(slot)) and self._replica.is_genuine(record):
            self._replica.keep(record, left)

    async def _send_lacking(self, contact: Contact, records: list[Record]) -> None:
        """Send ``contact`` the records that it lacks and this node should not hold.

        Once it has all of them, it is not asked again until there are others.
        """
        digest = digest_of(records)
        if not records or self._sent_digests.get(contact.node_id) == digest:
            return
        for begin in range(0, len(records), PLACES):
            page = records[begin : begin + PLACES]
            places = [[*record.slot, *mark_of(record)] for record in page]
            answer = await self._overlay.ask(contact, "lacking", places)
            if not (isinstance(answer, list) and len(answer) == len(page)):
                raise Refused(f"{contact.address} sends an invalid reply to lacking")
            await self._send_all(contact, [record for record, lacks in zip(page, answer, strict=True) if lacks])
        self._sent_digests[contact.node_id] = digest

    async def _send_all(self, contact: Contact, records: list[Record]) -> None:
        """Store ``records`` at ``contact``, page by page; ignore refusals, as for lack of room."""
        for page in pages_of(records, PLACES):
            lives = [self._replica.left(record) for record in page]
            with suppress(Refused):
                await self._overlay.ask(contact, "store", [r.packed() for r in page], lives, changes=True)

    async def _catch_up(self) -> None:
        """Reconcile with near nodes until their number implies that no acknowledged record is missing."""
        if self._catching_up:
            return
        self._catching_up = True
        try:
            while not self._standing.is_sure and not self._chores.is_stopped:
                if not self._overlay.is_complete and len(self._overlay.table) < K:
                    await self._chores.sleep(CONTACTS_WAIT_S)  # too few contacts are known yet
                    continue
                began = self._clock.seconds()
                others = self._near_nodes()
                # The first nodes have most records; the others need not send those again.
                reached = [await self._try_reconcile(contact) for contact in others[:FIRST_REPLICAS]]
                work = [Deferred.fromCoroutine(self._try_reconcile(contact)) for contact in others[FIRST_REPLICAS:]]
                reached += [await each for each in work]
                away = len(self._overlay.roster.absent()) if self._overlay.is_complete else 0
                if self._standing.is_enough(reached, away) and self._contact_at >= began - OUT_OF_TOUCH:
                    self._become_synced()
                    return
                await self._chores.sleep(CHECK_INTERVAL_S)
        finally:
            self._catching_up = False

    async def _try_reconcile(self, contact: Contact) -> int | None:
        """Reconcile with ``contact``; return its sync state, None on failure."""
        try:
            await self._reconcile(contact)
        except EntangledError:
            return None
        return self._standings[contact.node_id] if self._reconciled.get(contact.node_id, -1.0) >= 0.0 else None

    def _current_standing(self) -> int:
        self.is_sure()
        return self._standing.now

    def _become_synced(self) -> None:
        """Mark this node as synced, and announce it if that is the first time."""
        self._overlay.roster.is_settled = True
        if self._standing.settle() and not self._overlay.is_large:
            for contact in self._overlay.roster.live():
                self._chores.fork(self._overlay.ask(contact, "settled", changes=True))

    def _answer_settled(self, peer: Contact) -> None:
        """SETTLED: count the peer, which has caught up for the first time, as a voter."""
        self._overlay.roster.settle(peer.node_id)

    def _lose_sync(self) -> None:
        self._standing.is_sure = False
        self._reconciled.clear()
        self._chores.fork(self._catch_up())

    def _check_contact(self) -> None:
        now = self._clock.seconds()
        was_synced = self.is_sure()
        if not self._overlay.is_complete or self._overlay.roster.in_touch(now, OUT_OF_TOUCH):
            self._contact_at = now
        if not was_synced and not self._catching_up:
            self._chores.fork(self._catch_up())

    def _reconcile_random(self) -> None:
        """Reconcile with a random node, and republish the records that no other node republished."""
        others = self._near_nodes()
        if others:
            self._chores.fork(self._reconcile(others[self._rng.randrange(len(others))]))
        now = self._clock.seconds()
        records = self._replica.team_records()
        slots = {record.slot for record in records}
        self._stored_at = {slot: at for slot, at in self._stored_at.items() if slot in slots}
        for record in records:
            # At random times, so that one replica republishes and the others see it.
            due = self._stored_at.setdefault(record.slot, now - self._rng.random() * REPUBLISH / 2) + REPUBLISH
            if now > due and not self._owner.owns(record.slot):
                self._stored_at[record.slot] = now
                self._chores.fork(self._republish(record))

    async def _republish(self, record: Record) -> Any:
        targets = await self._overlay.holders(record.key)
        others = [contact for contact in targets if contact.node_id != self._own_id]
        left = self._replica.left(record)
        return await first(len(targets), [self._owner.store_at(contact, record, left) for contact in others])


def _is_list_of(parts: object, kind: type) -> bool:
    return isinstance(parts, list) and len(parts) == GROUPS and all(type(part) is kind for part in parts)


def _parse_place(fields: object) -> tuple[Slot, Mark, float] | None:
    """Parse an entry of a PLACES reply: slot, mark, seconds left; None if malformed."""
    if not isinstance(fields, list) or [type(part) for part in fields[3:]] != [int, bytes, int]:
        return None
    slot = slot_unpacked(fields[:3])
    return None if slot is None else (slot, (fields[3], fields[4]), float(fields[5]))
