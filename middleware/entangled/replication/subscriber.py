"""The watches of a node: registration at the replicas of the keys, and processing of their pushes.

Pushes are numbered.  When a number is missing, the subscriber immediately requests the records of the replica.
"""

from __future__ import annotations

from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from middleware.entangled.background import Background
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError, Refused
from middleware.entangled.identity import derive_node_id
from middleware.entangled.kademlia.distance import select_closest
from middleware.entangled.kademlia.overlay import Overlay
from middleware.entangled.record import Record, Slot, parse_record
from middleware.entangled.replication.reader import Reader
from middleware.entangled.replication.replica import Replica
from middleware.entangled.replication.watch import OnChanged, Watch
from middleware.entangled.wire.endpoint import Endpoint

RENEW_INTERVAL_S = 2.0
"""Seconds between two renewals of a watch: there are four renewals within ``WATCH_TTL_S``."""
LARGE_RENEW_INTERVAL_S, LARGE_TTL_S = 20.0, 60.0
"""Seconds between two renewals of a watch, and its duration in seconds, in a large network.  They are longer there,
because a lookup is needed to find the replicas."""
MAX_PUSHERS = 3
"""The number of replicas that push to one watcher in a large network, where thousands of nodes may watch the same
key."""


class Subscriber:
    """The watches of the node ``own_id``."""

    _log = Logger()

    def __init__(
        self,
        own_id: bytes,
        replica: Replica,
        overlay: Overlay,
        reader: Reader,
        endpoint: Endpoint,
        clock: IReactorTime,
        background: Background,
    ) -> None:
        self._own_id = own_id
        self._replica = replica
        self._overlay = overlay
        self._reader = reader
        self._clock = clock
        self._background = background
        self._watches: list[Watch] = []
        replica.on_owner_expired.add(self._forget_silent)
        endpoint.expose("push", self._answer_push, changes=True, idempotent=True)

    def start(self) -> None:
        """Start to renew the watches periodically."""
        self._background.every(RENEW_INTERVAL_S, self._renew_all)

    def stop(self) -> None:
        """End all watches without further notifications, and remove the watched copies."""
        self._watches.clear()
        self._replica.watched_copies.clear()

    def watch(self, key: bytes, changed: OnChanged, keep: bool) -> Watch:
        """Start a watch; see ``EntangledNode.watch``."""
        watch = Watch(key, changed, self._forget_watch, self._own_id, keep)
        self._watches.append(watch)
        watch.view.replace(self._own_id, self._replica.get_held(key))
        self._update(watch)
        self._background.fork(self._renew(watch))
        return watch

    def refresh(self, watch: Watch) -> None:
        """Request from all replicas of the key, immediately, the records that differ from the view."""
        self._background.fork(self._renew(watch))

    # -- events ----------------------------------------------------------------------------------------

    def handle_new_contact(self, contact: Contact) -> None:
        """Register the watches at a new node that is a replica of their keys."""
        for watch in self._watches:
            if self._overlay.is_replica(watch.key, contact):
                if self._overlay.is_large:
                    watch.due_at = 0.0
                else:
                    self._background.fork(self._renew_at(watch, contact))

    def forget_replica(self, replica: bytes) -> None:
        """Discard the records reported by the node with the id ``replica``."""
        for watch in list(self._watches):
            if replica in watch.requested:
                watch.due_at = 0.0
            watch.forget(replica)
            self._update(watch)

    def _forget_silent(self, owner: bytes) -> None:
        """Discard the records reported by a node whose own lease expired."""
        if derive_node_id(owner) != self._own_id:
            self.forget_replica(derive_node_id(owner))

    def handle_stored(self, record: Record) -> None:
        """Update the watches after this node stored ``record``."""
        for watch in [w for w in self._watches if w.key == record.key]:
            watch.view.add(self._own_id, record)
            self._update(watch)

    def handle_removed(self, record: Record) -> None:
        """Update the watches after this node removed ``record``."""
        for watch in [w for w in self._watches if w.key == record.key]:
            watch.view.remove(self._own_id, record.slot)
            self._update(watch)

    def recheck(self) -> None:
        """Drop the records that their owners may no longer write."""
        for watch in list(self._watches):
            if not all(self._replica.may_stay(record.slot) for record in watch.records):
                watch.view.retain(self._replica.may_stay)
                self._update(watch)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _forget_watch(self, watch: Watch) -> None:
        """Remove ``watch``; replicas drop it when it is no longer renewed."""
        if watch in self._watches:
            self._watches.remove(watch)
            if watch.has_copies:
                self._update_copies(watch.key)

    def _update(self, watch: Watch) -> None:
        try:
            watch.update()
        except Exception:
            self._log.failure("the callback of a watch of {key} raised", key=watch.key.hex())
        if watch.has_copies and watch in self._watches:
            self._update_copies(watch.key)

    def _update_copies(self, key: bytes) -> None:
        records = {r.slot: r for w in self._watches if w.has_copies and w.key == key for r in w.records}
        self._replica.watched_copies.replace(key, records.values(), self._clock.seconds())

    def _renew_all(self) -> None:
        now = self._clock.seconds()
        for watch in self._watches:
            if now >= watch.due_at or not self._overlay.is_large:
                self._background.fork(self._renew(watch))

    async def _renew(self, watch: Watch) -> None:
        watch.due_at = self._clock.seconds() + LARGE_RENEW_INTERVAL_S
        targets = await self._overlay.lookup_replicas(watch.key)
        if watch not in self._watches:
            return
        if self._overlay.is_large:
            targets = select_closest(targets, self._own_id, MAX_PUSHERS)  # so different watchers use different replicas
        ids = [c.node_id for c in targets]
        for replica in watch.view.replicas():
            # A replica without a renewed watch does not report removals.
            if replica not in ids and replica != self._own_id:
                watch.forget(replica)
        self._update(watch)
        for contact in targets:
            if contact.node_id != self._own_id:
                self._background.fork(self._renew_at(watch, contact))

    async def _renew_at(self, watch: Watch, contact: Contact, is_first: bool = True) -> None:
        watch.requested.add(contact.node_id)
        try:
            digest = watch.view.digest(contact.node_id)
            ttl = (LARGE_TTL_S,) if self._overlay.is_large else ()
            try:
                answer = await self._overlay.ask(contact, "watch", watch.key, digest, *ttl, changes=True)
            except Refused:  # the replica has too many watchers: read once instead
                watch.view.replace(contact.node_id, (await self._reader.read_pages(contact, watch.key)).records)
                return self._update(watch)
            number, page = answer if isinstance(answer, list) and len(answer) == 2 else (0, [[], None])
            if type(number) is not int:
                return
            # Pushes that overtook the answer have already advanced the number.
            watch.push_numbers[contact.node_id] = max(
                number, watch.push_numbers.get(contact.node_id, 0) if page is None else 0
            )
            if page is None:
                return
            records = (await self._reader.read_pages(contact, watch.key, page)).records
        except EntangledError:
            if is_first and watch in self._watches:
                await self._renew_at(watch, contact, is_first=False)  # a single lost message does not end the watch
            elif watch in self._watches:
                watch.forget(contact.node_id)
                self._update(watch)
            return
        if watch in self._watches and contact.node_id in watch.requested:
            watch.view.replace(contact.node_id, records)
            self._update(watch)

    def _answer_push(self, peer: Contact, key: bytes, number: int, packed: list[object], removed: list[object]) -> None:
        self._overlay.process_message(peer)
        received = [record for record in map(parse_record, packed) if record is not None]
        is_lacking = bool(self._replica.certificates.find_missing(peer, (record.owner for record in received)))
        records = [record for record in received if self._reader.is_credible(record, key, peer)]
        slots = [slot for place in removed if (slot := _parse_slot(key, place)) is not None]
        for watch in [w for w in self._watches if w.key == key and peer.node_id in w.requested]:
            last = watch.push_numbers.get(peer.node_id, 0)
            watch.push_numbers[peer.node_id] = max(last, number)
            for record in records:
                watch.view.add(peer.node_id, record)
            if number > last:  # a late push may remove a record that was written again in the meantime
                for slot in slots:
                    watch.view.remove(peer.node_id, slot)
            self._update(watch)
            # A push with the last number is a duplicate, not a gap.  The renewal also requests unknown certificates of
            # owners.
            if is_lacking or number not in (last, last + 1):
                self._background.fork(self._renew_at(watch, peer))


def _parse_slot(key: bytes, place: object) -> Slot | None:
    if not isinstance(place, list) or len(place) != 2:
        return None
    owner, name = place
    return Slot(key, owner, name) if isinstance(owner, bytes) and isinstance(name, str) else None
