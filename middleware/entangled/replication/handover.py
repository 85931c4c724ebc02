"""Handover: how what is held reaches those who should hold it, as nodes come, go and come back.

Two nodes *reconcile*: they compare digests of what both should hold, then the places that differ, and each gives the
other what it lacks.  Every node does so with whoever is new to it, and now and then with one of the others.  A node
that was away or is new is not *sure* of what it holds before it has reconciled with a majority; until then its word
does not count.  What a lost node held goes to the next in line.
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

STEWARDS = 2
MEND = 10.0
OUT_OF_TOUCH = STRUCK_S / 2
"""Seconds without a majority in touch after which a node may have been struck, and is sure of nothing."""
AGAIN = 1.0
LONGER = 60.0
"""Seconds by which another holder's word must exceed what is left of a record here before it counts: its way here does
not make a record older, and may take seconds."""
MUCH_LONGER = 1800
"""Seconds by which the lives of a part may differ in sum before they are looked at one by one."""
NOT_YET = 0.1
WELCOME = 1.0
"""Seconds, and as much again at most, that a newcomer is left to catch up by itself."""


class Handover:
    """What one node gives to others and gets from them, beside what clients write and read."""

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
        self._touched_at = clock.seconds()
        self._standing = Standing(store)
        self._reconciled: dict[bytes, float] = {}
        self._standings: dict[bytes, int] = {}
        self._busy: set[bytes] = set()
        self._catching_up = False
        self._stored_at: dict[Slot, float] = {}
        self._given: dict[bytes, bytes] = {}
        self._overlap = Overlap(replica, overlay, endpoint, clock)
        self._overlap.standing = self._standing_now
        endpoint.expose("settled", self._answer_settled, changes=True, idempotent=True)

    def start(self, forgot: bool = False) -> None:
        """Compare with others from time to time, and know when this node has lost touch.

        ``forgot``: what an earlier life held is not here any more, though others may count on it.
        """
        self._standing.start(forgot)
        self._overlay.roster.is_settled = self._standing.now != NOVICE
        self._touched_at = self._clock.seconds()
        self._chores.every(MEND, self._mend)
        self._chores.every(AGAIN, self._look_around)

    def is_sure(self) -> bool:
        """Whether this node has caught up with the others and was in touch with a majority ever since."""
        if self._standing.is_sure and self._clock.seconds() - self._touched_at > OUT_OF_TOUCH:
            self._doubt()
        return self._standing.is_sure

    def joined(self) -> None:
        """This node knows where it is; alone in its network it has nothing to catch up with."""
        if not len(self._overlay.roster) and not self._overlay.roster.absent():
            self._settle()
        else:
            self._chores.fork(self._catch_up())

    def welcome(self, contact: Contact) -> None:
        """Reconcile with a newcomer, unless it has done so by itself before."""
        if self._is_near(contact):
            self._chores.later(WELCOME * (1 + self._rng.random()), self._welcome, contact, self._clock.seconds())

    def lost(self, contact: Contact) -> None:
        """Give the records that a lost contact held to the node that takes its place."""
        self._reconciled.pop(contact.node_id, None)
        self._overlap.asked_at.pop(contact.node_id, None)
        self._given.pop(contact.node_id, None)
        self._standings.pop(contact.node_id, None)
        heirs: dict[bytes, tuple[Contact, list[Record]]] = {}
        for record in self._replica.team_records():
            nearest = self._overlay.responsible(record.key)
            if len(nearest) < K or all(c.node_id != self._own_id for c in nearest[:STEWARDS]):
                continue
            heir = nearest[-1]
            was_closer = distance(contact.node_id, record.key) < distance(heir.node_id, record.key)
            if was_closer and heir.node_id != self._own_id:
                heirs.setdefault(heir.node_id, (heir, []))[1].append(record)
        for heir, records in heirs.values():
            self._chores.fork(self._give_all(heir, records))

    def stored(self, record: Record) -> None:
        """Another holder or the owner has just given ``record`` on: no need to do so soon."""
        self._stored_at[record.slot] = self._clock.seconds()

    # -- inside -----------------------------------------------------------------------------------------------------

    def _welcome(self, contact: Contact, since: float) -> None:
        compared_at = max(
            self._reconciled.get(contact.node_id, -1.0), self._overlap.asked_at.get(contact.node_id, -1.0)
        )
        if compared_at < since:
            self._chores.fork(self._reconcile(contact))

    def _is_near(self, contact: Contact) -> bool:
        """Whether this node and ``contact`` may have records in common."""
        return self._overlay.is_complete or contact in self._others()

    def _others(self) -> list[Contact]:
        """Those with whom this node may have records in common."""
        return self._overlay.roster.live() if self._overlay.is_complete else self._overlay.neighbours()

    async def _reconcile(self, contact: Contact) -> None:
        """Give ``contact`` what it lacks, and get from it what this node lacks."""
        if contact.node_id in self._busy:
            return
        self._busy.add(contact.node_id)
        try:
            began = self._clock.seconds()
            bit = self._rng.randrange(BITS)
            answer = await self._overlay.ask(
                contact, "digests", bit, self._standing_now(), is_light=self._overlay.is_large
            )
            digests, extra, lives, standing = (
                answer if isinstance(answer, list) and len(answer) == 4 else ([], 0, [], 0)
            )
            mine, to_give = self._overlap.both(contact)
            if not (_is_list_of(digests, bytes) and _is_list_of(lives, int)):
                raise Refused(f"{contact.address} gives no digests")
            for group, (digest, life) in enumerate(zip(digests, lives, strict=True)):
                is_longer = life > self._overlap.life(mine[group], bit) + MUCH_LONGER
                if is_longer or digest != digest_of(mine[group]):
                    await self._compare(contact, group, mine[group])
            if extra:
                await self._compare(contact, -1, [])
            await self._give_lacking(contact, to_give)
            self._reconciled[contact.node_id] = began
            self._standings[contact.node_id] = standing if standing in (ELDER, SURE) else NOVICE
            self._overlay.roster.settle(contact.node_id, standing in (ELDER, SURE))
        finally:
            self._busy.discard(contact.node_id)

    async def _compare(self, contact: Contact, group: int, mine: list[Record]) -> None:
        theirs: dict[Slot, Mark] = {}
        after: Slot | None = None
        while True:
            answer = await self._overlay.ask(contact, "places", group, [] if after is None else list(after))
            places = [place for place in map(_place, answer) if place is not None] if isinstance(answer, list) else []
            for slot, mark, left in places:
                theirs[slot] = mark
                self._stay(slot, mark, left)
            if len(places) < PLACES or (after is not None and places[-1][0] <= after):
                break
            after = places[-1][0]
        wanted = [slot for slot, mark in theirs.items() if mark > mark_of(self._replica.shown(slot))]
        await self._fetch(contact, wanted)
        lacked = [record for record in mine if mark_of(record) > theirs.get(record.slot, (-1, b""))]
        await self._give_all(contact, lacked)

    def _stay(self, slot: Slot, mark: Mark, left: float) -> None:
        """Hold what ``slot`` holds for ``left`` seconds, where that is longer and the very record is meant.

        So the longest life that any holder names is that of all: one that names a short one ends nothing.
        """
        record = self._replica.shown(slot)
        if record is None or record.lifetime != "team" or mark_of(record) != mark:
            return
        if min(left, record.ttl) > self._replica.left(record) + LONGER:
            self._replica.keep(record, left)

    async def _fetch(self, contact: Contact, wanted: list[Slot]) -> None:
        """Get what ``contact`` holds in the slots, page by page."""
        while wanted:
            answer = await self._overlay.ask(contact, "fetch", [list(slot) for slot in wanted[:PLACES]])
            page = answer if isinstance(answer, list) else []
            await self._replica.certificates.learn(contact, (slot.owner for slot in wanted[: len(page)]))
            for slot, fields in zip(wanted, page, strict=False):
                self._take(slot, fields)
            wanted = wanted[len(page) :] if page else []

    def _take(self, slot: Slot, found: object) -> None:
        """Keep a record that was fetched, where it is one and beats what is here."""
        fields, left = found if isinstance(found, list) and len(found) == 2 else (None, None)
        record = unpacked(fields)
        if record is None or record.slot != slot or type(left) is not float or record.lifetime != "team":
            return
        if record.beats(self._replica.shown(slot)) and self._replica.is_genuine(record):
            self._replica.keep(record, left)

    async def _give_lacking(self, contact: Contact, records: list[Record]) -> None:
        """Store at ``contact`` what it lacks of ``records``, none of which should be here.

        Once it has them, no more is said until there are others.
        """
        digest = digest_of(records)
        if not records or self._given.get(contact.node_id) == digest:
            return
        for begin in range(0, len(records), PLACES):
            page = records[begin : begin + PLACES]
            places = [[*record.slot, *mark_of(record)] for record in page]
            answer = await self._overlay.ask(contact, "lacking", places)
            if not (isinstance(answer, list) and len(answer) == len(page)):
                raise Refused(f"{contact.address} does not say what it lacks")
            await self._give_all(contact, [record for record, lacks in zip(page, answer, strict=True) if lacks])
        self._given[contact.node_id] = digest

    async def _give_all(self, contact: Contact, records: list[Record]) -> None:
        """Store at ``contact``, page by page; what it has no room for it does without."""
        for page in pages_of(records, PLACES):
            lives = [self._replica.left(record) for record in page]
            with suppress(Refused):
                await self._overlay.ask(contact, "store", [r.packed() for r in page], lives, changes=True)

    async def _catch_up(self) -> None:
        """Reconcile with near nodes, so many that nothing acknowledged can be missed."""
        if self._catching_up:
            return
        self._catching_up = True
        try:
            while not self._standing.is_sure and not self._chores.is_stopped:
                if not self._overlay.is_complete and len(self._overlay.table) < K:
                    await self._chores.sleep(NOT_YET)  # it has yet to hear who is there
                    continue
                began = self._clock.seconds()
                others = self._others()
                # One first, who has most of it; what it gave, the next ones need not give.
                reached = [await self._caught_up_with(contact) for contact in others[:STEWARDS]]
                work = [Deferred.fromCoroutine(self._caught_up_with(contact)) for contact in others[STEWARDS:]]
                reached += [await each for each in work]
                away = len(self._overlay.roster.absent()) if self._overlay.is_complete else 0
                if self._standing.is_enough(reached, away) and self._touched_at >= began - OUT_OF_TOUCH:
                    self._settle()
                    return
                await self._chores.sleep(AGAIN)
        finally:
            self._catching_up = False

    async def _caught_up_with(self, contact: Contact) -> int | None:
        """The standing of ``contact`` once this node has reconciled with it; None where that fails."""
        try:
            await self._reconcile(contact)
        except EntangledError:
            return None
        return self._standings[contact.node_id] if self._reconciled.get(contact.node_id, -1.0) >= 0.0 else None

    def _standing_now(self) -> int:
        self.is_sure()
        return self._standing.now

    def _settle(self) -> None:
        """From now on this node is sure, and counts."""
        self._overlay.roster.is_settled = True
        if self._standing.settle() and not self._overlay.is_large:
            for contact in self._overlay.roster.live():
                self._chores.fork(self._overlay.ask(contact, "settled", changes=True))

    def _answer_settled(self, peer: Contact) -> None:
        """SETTLED: the peer has caught up for the first time, and counts."""
        self._overlay.roster.settle(peer.node_id)

    def _doubt(self) -> None:
        self._standing.is_sure = False
        self._reconciled.clear()
        self._chores.fork(self._catch_up())

    def _look_around(self) -> None:
        now = self._clock.seconds()
        was = self.is_sure()
        if not self._overlay.is_complete or self._overlay.roster.in_touch(now, OUT_OF_TOUCH):
            self._touched_at = now
        if not was and not self._catching_up:
            self._chores.fork(self._catch_up())

    def _mend(self) -> None:
        """Compare with one of the others, and give on what nobody gave on for long."""
        others = self._others()
        if others:
            self._chores.fork(self._reconcile(others[self._rng.randrange(len(others))]))
        now = self._clock.seconds()
        records = self._replica.team_records()
        slots = {record.slot for record in records}
        self._stored_at = {slot: at for slot, at in self._stored_at.items() if slot in slots}
        for record in records:
            # A different moment for each, so that the first one's word keeps the others quiet.
            due = self._stored_at.setdefault(record.slot, now - self._rng.random() * REPUBLISH / 2) + REPUBLISH
            if now > due and not self._owner.owns(record.slot):
                self._stored_at[record.slot] = now
                self._chores.fork(self._spread(record))

    async def _spread(self, record: Record) -> Any:
        targets = await self._overlay.holders(record.key)
        others = [contact for contact in targets if contact.node_id != self._own_id]
        left = self._replica.left(record)
        return await first(len(targets), [self._owner.store_at(contact, record, left) for contact in others])


def _is_list_of(parts: object, kind: type) -> bool:
    return isinstance(parts, list) and len(parts) == GROUPS and all(type(part) is kind for part in parts)


def _place(fields: object) -> tuple[Slot, Mark, float] | None:
    """A slot, the mark of what it holds and the seconds left to that, as PLACES tells them; None for anything else."""
    if not isinstance(fields, list) or [type(part) for part in fields[3:]] != [int, bytes, int]:
        return None
    slot = slot_unpacked(fields[:3])
    return None if slot is None else (slot, (fields[3], fields[4]), float(fields[5]))
