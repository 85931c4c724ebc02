"""Subscriber: what a node reads from others, once (``read``) or kept up to date (``watch``).

It asks the replicas of a key, checks what they say, and hands it to the views.
"""

from __future__ import annotations

from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from middleware.entangled.background import Background, first
from middleware.entangled.errors import Alone, EntangledError
from middleware.entangled.identity import node_id
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.overlay import Overlay
from middleware.entangled.record import Record, Slot, unpacked
from middleware.entangled.replica import Replica
from middleware.entangled.watch import Changed, View, Watch
from middleware.entangled.wire.endpoint import Endpoint

RENEW = 2.0
MAX_PAGES = 1000


class Subscriber:
    """The reads and watches of the node ``own_id``."""

    _log = Logger()

    def __init__(
        self,
        own_id: bytes,
        replica: Replica,
        overlay: Overlay,
        endpoint: Endpoint,
        clock: IReactorTime,
        chores: Background,
    ) -> None:
        self._own_id = own_id
        self._replica = replica
        self._overlay = overlay
        self._clock = clock
        self._chores = chores
        self._watches: list[Watch] = []
        endpoint.expose("push", self._answer_push, changes=True)

    def start(self) -> None:
        """Renew the watches from now on."""
        self._chores.every(RENEW, self._renew_all)

    def stop(self) -> None:
        """End every watch; nothing is told any more, and no copy is kept."""
        self._watches.clear()
        self._replica.keepsakes.clear()

    async def read(self, key: bytes) -> list[Record]:
        """The merged answers of all replicas of ``key`` that answer; raises ``Alone`` where none does."""
        targets = await self._overlay.holders(key)
        view = View(self._own_id)
        others = [c for c in targets if c.node_id != self._own_id]
        if len(others) < len(targets):
            view.replace(self._own_id, self._replica.held(key))

        async def read_at(contact: Contact) -> None:
            view.replace(contact.node_id, await self._pages(contact, key, None))

        answered = await first(len(others), [read_at(c) for c in others])
        if others and not answered:
            raise Alone("no node that holds this key answers")
        return view.merged()

    def watch(self, key: bytes, changed: Changed, keep: bool) -> Watch:
        """Begin a watch; see ``EntangledNode.watch``."""
        watch = Watch(key, changed, self, self._own_id, keep)
        self._watches.append(watch)
        watch.view.replace(self._own_id, self._replica.held(key))
        self._settle(watch)
        self._chores.fork(self._renew(watch))
        return watch

    def unwatch(self, watch: Watch) -> None:
        """Forget ``watch``; replicas forget it by themselves when it is not renewed."""
        if watch in self._watches:
            self._watches.remove(watch)
            if watch.keep:
                self._copy(watch.key)

    def refresh(self, watch: Watch) -> None:
        """Ask every holder of the key now whether it holds anything else than what is believed."""
        self._chores.fork(self._renew(watch))

    # -- what the node hears ----------------------------------------------------------------------------------------

    def welcome(self, contact: Contact) -> None:
        """Hear what a newcomer holds of watched keys."""
        for watch in self._watches:
            if self._overlay.belongs(watch.key, contact):
                self._chores.fork(self._renew_at(watch, contact))

    def forget(self, replica: bytes) -> None:
        """What the node with the id ``replica`` said does not count any more."""
        for watch in list(self._watches):
            watch.forget(replica)
            self._settle(watch)

    def silent(self, owner: bytes) -> None:
        """Whoever let its lease run out no longer speaks for others either."""
        if node_id(owner) != self._own_id:
            self.forget(node_id(owner))

    def held_here(self, record: Record) -> None:
        """This node now holds ``record``."""
        for watch in [w for w in self._watches if w.key == record.key]:
            watch.view.add(self._own_id, record)
            self._settle(watch)

    def gone_here(self, record: Record) -> None:
        """This node no longer holds ``record``."""
        for watch in [w for w in self._watches if w.key == record.key]:
            watch.view.remove(self._own_id, record.slot)
            self._settle(watch)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _settle(self, watch: Watch) -> None:
        try:
            watch.settle()
        except Exception:
            self._log.failure("a subscriber of {key} failed", key=watch.key.hex())
        if watch.keep and watch in self._watches:
            self._copy(watch.key)

    def _copy(self, key: bytes) -> None:
        records = {r.slot: r for w in self._watches if w.keep and w.key == key for r in w.records}
        self._replica.keepsakes.keep(key, records.values(), self._clock.seconds())

    def _renew_all(self) -> None:
        for watch in self._watches:
            self._chores.fork(self._renew(watch))

    async def _renew(self, watch: Watch) -> None:
        targets = await self._overlay.holders(watch.key)
        if watch not in self._watches:
            return
        ids = [c.node_id for c in targets]
        for replica in watch.view.replicas():
            # Whoever is not asked any more will not tell when its opinion ends.
            if replica not in ids and replica != self._own_id:
                watch.forget(replica)
        self._settle(watch)
        for contact in targets:
            if contact.node_id != self._own_id:
                self._chores.fork(self._renew_at(watch, contact))

    async def _renew_at(self, watch: Watch, contact: Contact) -> None:
        watch.asked.add(contact.node_id)
        try:
            digest = watch.view.digest(contact.node_id)
            page = await self._overlay.ask(contact, "watch", watch.key, digest, changes=True)
            if page is None:
                return
            records = await self._pages(contact, watch.key, page)
        except EntangledError:
            if watch in self._watches:
                watch.forget(contact.node_id)
                self._settle(watch)
            return
        if watch in self._watches and contact.node_id in watch.asked:
            watch.view.replace(contact.node_id, records)
            self._settle(watch)

    async def _pages(self, contact: Contact, key: bytes, page: object) -> list[Record]:
        """What ``contact`` holds under ``key``, from ``page`` on (None: from the first one)."""
        records: list[Record] = []
        if page is None:
            page = await self._overlay.ask(contact, "find_value", key, None)
        for _ in range(MAX_PAGES):
            if not (isinstance(page, list) and len(page) == 2 and isinstance(page[0], list) and page[0]):
                break
            records += [r for r in map(unpacked, page[0]) if r is not None and self._is_credible(r, key, contact)]
            if page[1] is None:
                break
            page = await self._overlay.ask(contact, "find_value", key, page[1])
        return records

    def _is_credible(self, record: Record, key: bytes, contact: Contact) -> bool:
        if record.key != key:
            return False
        return record.owner == contact.public or record in self._replica.held(key) or record.is_genuine()

    def _answer_push(self, peer: Contact, key: bytes, packed: list[object], gone: list[object]) -> None:
        self._overlay.heard(peer)
        records = [r for r in map(unpacked, packed) if r is not None and self._is_credible(r, key, peer)]
        slots = [slot for place in gone if (slot := _slot_of(key, place)) is not None]
        for watch in [w for w in self._watches if w.key == key and peer.node_id in w.asked]:
            for record in records:
                watch.view.add(peer.node_id, record)
            for slot in slots:
                watch.view.remove(peer.node_id, slot)
            self._settle(watch)


def _slot_of(key: bytes, place: object) -> Slot | None:
    if not isinstance(place, list) or len(place) != 2:
        return None
    owner, name = place
    return Slot(key, owner, name) if isinstance(owner, bytes) and isinstance(name, str) else None
