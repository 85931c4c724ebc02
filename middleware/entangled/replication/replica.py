"""The records that a node stores as one of the replicas of their keys.

A replica answers STORE and FIND_VALUE, extends leases when their owners renew them, passes changes to ``pusher``, and
removes expired records.  ``overlay`` decides which nodes are the replicas of a key.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from functools import wraps

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background
from middleware.entangled.contact import Contact
from middleware.entangled.data.store import Store
from middleware.entangled.errors import OWNER_FULL, Full, Refused
from middleware.entangled.kademlia.overlay import Overlay
from middleware.entangled.listeners import Listeners
from middleware.entangled.record import KEY_BYTES, Record, SignatureCache, Slot, parse_record
from middleware.entangled.replication.cache import PathCache
from middleware.entangled.replication.owner_certificates import Certificates
from middleware.entangled.replication.pusher import WATCH_TTL_S, Pusher
from middleware.entangled.replication.store_reply import STORED, UNSYNCED, Outcome, StoreReply
from middleware.entangled.replication.watch import digest_of
from middleware.entangled.replication.watched_copy import WatchedCopies
from middleware.entangled.wire.admission_check import Authority
from middleware.entangled.wire.endpoint import Endpoint

PAGE_BYTES = 12_000
"""The approximate bytes of a page, which fits into the initial congestion window of ten datagrams."""
SWEEP_INTERVAL_S, MAX_SWEEP_INTERVAL_S = 0.1, 60.0
"""Minimum and maximum seconds between two checks for expired records."""
MAX_LEASE_S = 3600.0
MAX_MARKS = 100
MAX_MISMATCHED = 4096
"""The number of peers that are remembered because their last ALIVE did not match the stored records."""

UNSYNCED_REPLY, SYNCED_REPLY, CACHED_REPLY = 0, 1, 2
"""The kinds of a reply: from a replica that is not synced, from a synced replica, or a cached copy."""


class Replica:
    """The records that one node stores for other owners; its ``watched_copies`` are not visible to peers.

    ``may_store`` returns whether the current certificate of a slot's owner allows it to write there.  ``may_stay``
    returns whether an existing record in the slot may still be stored and returned.  The results of the two functions
    differ for few slots.  ``is_synced`` returns whether this node is synced.

    ``on_record`` is called with each accepted record, and ``on_gone`` with each removed record.  ``on_owner_expired``
    is called with the public key of each owner whose lease expired or that sent GOODBYE.
    """

    def __init__(
        self, store: Store, endpoint: Endpoint, overlay: Overlay, clock: IReactorTime, background: Background
    ) -> None:
        self.watched_copies = WatchedCopies(store)
        self._store = store
        self._endpoint = endpoint
        self._overlay = overlay
        self._clock = clock
        self.pusher = Pusher(endpoint, clock, background)
        self.cache = PathCache()
        self._signature_cache = SignatureCache()
        self.certificates = Certificates(endpoint, clock)
        self.may_store: Callable[[Slot], bool] = endpoint.admission.may_store
        self.may_stay: Callable[[Slot], bool] = endpoint.admission.may_keep
        self._authorities: dict[bytes, Authority] = {}
        self.is_synced: Callable[[], bool] = lambda: True
        self._mismatched: set[bytes] = set()
        self._swept_at = self._sweep_at = -1.0
        self._cancel_sweep: Callable[[], None] = lambda: None
        self.on_record = Listeners[[Record]]()
        self.on_gone = Listeners[[Record]]()
        self.on_owner_expired = Listeners[[bytes]]()
        self._background = background
        endpoint.expose("store", self._wait_for_write(self.answer_store), changes=True, idempotent=True)
        endpoint.expose("find_value", self.answer_find_value, early=True)
        endpoint.expose("cache", self.answer_cache, changes=True, idempotent=True)
        endpoint.expose("watch", self.answer_watch, changes=True, idempotent=True)
        endpoint.expose("alive", self.answer_alive, changes=True, idempotent=True)
        endpoint.expose("let_go", self.answer_let_go, changes=True, idempotent=True)
        endpoint.expose("goodbye", self.answer_goodbye, changes=True)

    def start(self) -> None:
        """Start to remove expired records and watchers."""
        self._swept_at = self._clock.seconds()
        self._schedule_sweep()
        self.pusher.start()

    def get_held(self, key: bytes) -> list[Record]:
        """Return the records stored under ``key`` as a replica, tombstones included."""
        copies = self.watched_copies.slots_of(key)
        return [r for r in self._store.get(key, tombstones=True) if r.slot not in copies and self.may_stay(r.slot)]

    def get_visible(self, slot: Slot) -> Record | None:
        """Return the record stored in ``slot`` as a replica, if peers may see it."""
        return None if slot in self.watched_copies or not self.may_stay(slot) else self._store.get_slot(slot)

    def team_records(self) -> list[Record]:
        """Return the team records stored as a replica that peers may see, tombstones included."""
        copies = self.watched_copies
        return [
            r for r in self._store.records() if r.lifetime == "team" and r.slot not in copies and self.may_stay(r.slot)
        ]

    def holds(self, record: Record) -> bool:
        """Return whether exactly ``record`` is stored as a replica."""
        return self._store.get_slot(record.slot) == record and record.slot not in self.watched_copies

    def store_locally(self, record: Record, left: float | None = None) -> StoreReply:
        """Store ``record`` if it supersedes the record in its slot; return STORED or SUPERSEDED.

        The record expires after ``left`` seconds, its remaining lifetime at the sender; by default after a whole ttl.
        """
        self.watched_copies.remove(record.slot)
        self.cache.drop(record.key)
        before = self._store.get_slot(record.slot)
        life = record.ttl if left is None else min(left, record.ttl)
        if self._store.put(record, self._clock.seconds() + life):
            self._sweep_earlier()
            self.on_record(record)
            self.pusher.push(record.key, [record], [])
        elif before is not None and before.sequence >= record.sequence and before.signature != record.signature:
            return StoreReply(Outcome.SUPERSEDED, before.sequence)
        return STORED

    def store(self, record: Record, left: float | None = None) -> StoreReply:
        """Store ``record`` as ``store_locally`` does; return UNSYNCED instead of STORED if this node is not synced."""
        reply = self.store_locally(record, left)
        return UNSYNCED if reply is STORED and not self.is_synced() else reply

    def remaining_lifetime(self, record: Record) -> float:
        """Return the seconds until the record in this slot expires; if the slot is empty, the ttl of ``record``."""
        expiry = self._store.find_expiry(record.slot)
        return record.ttl if expiry is None else expiry - self._clock.seconds()

    def recheck(self) -> bool:
        """Check the records of owners with a changed authority; return whether there are any such owners.

        If an owner may no longer write a record, watchers are notified that the record is gone.  If the authority is
        final, the record is removed.  If the reason is the clock or a missing certificate, the record is hidden until
        it is allowed or expires.
        """
        before, admission = self._authorities, self.certificates.admission
        self._authorities = {owner: admission.find_authority(owner) for owner in self._store.owners()}
        changed = [owner for owner, authority in self._authorities.items() if before.get(owner) != authority]
        for owner in changed:
            self._apply_authority(owner, self._authorities[owner], before.get(owner))
        return bool(changed)

    # -- requests of peers ---------------------------------------------------------------------------------------------

    def answer_store(
        self, peer: Contact, packed: list[object], left: list[object] | None = None
    ) -> list[int] | Deferred[list[int]]:
        """Answer STORE: store records; return the code of a ``StoreReply`` for each record.

        ``left`` is the remaining lifetime in seconds of each record, if the sender is not the owner.  Unknown
        certificates are requested from ``peer``.
        """
        self._overlay.process_message(peer)
        records = [record for record in map(parse_record, packed) if record is not None]
        lives = [None] * len(packed) if left is None else [_check_lifetime(life) for life in left]
        if len(records) < len(packed) or len(lives) != len(packed):
            raise Refused("the argument is not a list of valid records")
        owners = [record.owner for record in records]
        if self.certificates.find_missing(peer, owners):
            learning = Deferred.fromCoroutine(self.certificates.fetch_missing(peer, owners))
            return learning.addCallback(lambda _: self._store_all(peer, records, lives))
        return self._store_all(peer, records, lives)

    def answer_find_value(
        self,
        peer: Contact,
        key: bytes,
        after: list[object] | None = None,
        wants_synced: bool = False,
        digest: bytes = b"",
    ) -> list[object]:
        """Answer FIND_VALUE: return a page of records of ``key``, the next page's cursor or None, and the reply's kind.

        If this node has no records of the key, it also returns the contacts closest to the key; unless
        ``wants_synced``, it may return a cached copy.  If this node is not among the nodes closest to the key, its
        records may be incomplete, so a lookup also gets these contacts.  If ``digest`` equals the digest of all stored
        records, None is returned instead of the records.
        """
        if digest and digest == digest_of(self.get_held(_check_key(key))):
            return [None, None, self._sync_level()]
        page, following = self._make_page(_check_key(key), after)
        is_nothing = not page and after is None
        cached = self.cache.get(key, self._clock.seconds()) if is_nothing and not wants_synced else None
        if cached:
            return [[record.pack() for record in cached if self.may_store(record.slot)], None, CACHED_REPLY]
        is_aside = not is_nothing and not wants_synced and not self._overlay.is_responsible(key)
        if not (is_nothing or is_aside):
            return [page, following, self._sync_level()]
        near = [contact.pack() for contact in self._overlay.find_nearest(key) if contact.node_id != peer.node_id]
        return [page, following, UNSYNCED_REPLY if is_aside else self._sync_level(), near]

    def answer_cache(self, peer: Contact, key: bytes, packed: list[object], ttl: float) -> None:
        """Answer CACHE: cache records that a lookup found, for later lookups on its path (Kademlia, section 2.3)."""
        records = [record for record in map(parse_record, packed) if record is not None]
        if len(records) < len(packed) or any(record.key != _check_key(key) for record in records):
            raise Refused("the records do not belong to this key")
        if not self.get_held(key) and all(self.is_genuine(record) for record in records):
            self.cache.put(key, records, ttl, self._clock.seconds())

    def answer_watch(self, peer: Contact, key: bytes, digest: bytes, ttl: float = WATCH_TTL_S) -> list[object]:
        """Answer WATCH: push changes of ``key`` to ``peer`` for ``ttl`` seconds, at most one minute.

        Returns the number of the last push, and the first page of records; None instead of the page if ``digest``
        equals the digest of the records.
        """
        self._overlay.process_message(peer)
        number = self.pusher.add_watcher(_check_key(key), peer, ttl)
        return [number, None if digest == digest_of(self.get_held(key)) else list(self._make_page(key, None))]

    def answer_alive(self, peer: Contact, lease: float, digest: bytes) -> None:
        """Answer ALIVE: extend the leases of ``peer``.

        If ``digest`` does not match the stored records of the peer in two successive requests, this node sends MISSING.
        If this node stores no records of the peer, they have expired although the peer is alive, and MISSING is sent
        immediately.
        """
        self._overlay.process_message(peer)
        held = self._list_leased(peer.public)
        self._store.extend_leases(peer.public, self._clock.seconds() + min(float(lease), MAX_LEASE_S))
        if digest == digest_of(held):
            self._mismatched.discard(peer.node_id)
        elif peer.node_id in self._mismatched or not held:
            self._mismatched.discard(peer.node_id)
            self._endpoint.notify(peer, "missing", [digest_of([r]) for r in held[:MAX_MARKS]])
        else:
            if len(self._mismatched) >= MAX_MISMATCHED:
                self._mismatched.clear()  # a peer that is forgotten here gets MISSING one renewal later
            self._mismatched.add(peer.node_id)

    def answer_let_go(self, peer: Contact, marks: list[object]) -> None:
        """Answer LET_GO: remove leased records of ``peer`` that no longer belong here, identified by their digests."""
        self._notify_gone(
            [r for r in self._list_leased(peer.public) if digest_of([r]) in marks and self._store.discard(r.slot)]
        )

    def answer_goodbye(self, peer: Contact) -> None:
        """Answer GOODBYE: remove the leased records of ``peer``, which leaves the network (thesis, section 4.2.2)."""
        self._notify_gone(self._store.drop_leased(peer.public))
        self.on_owner_expired(peer.public)
        self.pusher.forget(peer)
        self._mismatched.discard(peer.node_id)
        self._overlay.remove(peer)

    def _find_refusal(self, record: Record, peer: Contact) -> StoreReply | None:
        if not self.may_store(record.slot):
            return StoreReply(Outcome.FORBIDDEN)
        return None if self.may_accept(record, peer) else StoreReply(Outcome.FORGED)

    def may_accept(self, record: Record, peer: Contact) -> bool:
        """Return whether ``peer`` may store ``record``.

        If ``peer`` is the owner, its session authenticates the record.  From any other peer a team record needs a valid
        signature.  Leased records are accepted only from their owner, because they must expire when their owner is
        silent.
        """
        return record.owner == peer.public or (record.lifetime == "team" and self.is_genuine(record))

    def is_genuine(self, record: Record) -> bool:
        """Return whether the owner may write ``record`` and has signed it.

        The signature of a record that this node already stores is not checked again.
        """
        return self.may_store(record.slot) and (self.holds(record) or self._signature_cache.is_genuine(record))

    # -- inside -----------------------------------------------------------------------------------------------------

    def _wait_for_write(
        self, answer: Callable[..., list[int] | Deferred[list[int]]]
    ) -> Callable[..., Deferred[list[int]]]:
        """Wrap ``answer`` so that its result is sent only after the store has written the changes durably."""

        def written(answers: list[int]) -> Deferred[list[int]]:
            return self._store.wait_for_write().addCallback(lambda _: answers)

        @wraps(answer)
        def acknowledged(*arguments: object) -> Deferred[list[int]]:
            answers = answer(*arguments)
            return answers.addCallback(written) if isinstance(answers, Deferred) else written(answers)

        return acknowledged

    def _store_all(self, peer: Contact, records: list[Record], lives: Sequence[float | None]) -> list[int]:
        """Store the valid ones of ``records``; a full share of one owner does not affect other owners."""
        replies = []
        for record, life in zip(records, lives, strict=True):
            try:
                replies.append(self._find_refusal(record, peer) or self.store(record, life))
            except Full as error:
                if len(records) == 1 or error.code != OWNER_FULL:
                    raise
                replies.append(StoreReply(Outcome.NO_ROOM))
        return [reply.encode() for reply in replies]

    def _apply_authority(self, owner: bytes, authority: Authority, before: Authority | None) -> None:
        """Hide or remove the records that ``owner`` may not write, and make its other records visible again."""
        hidden = []
        for record in self._store.find_owned(owner):
            if not self.may_stay(record.slot):
                hidden.append(record)
            elif before is not None and before.refusal and record.slot not in self.watched_copies:
                self.on_record(record)
                self.pusher.push(record.key, [record], [])
        self._notify_gone(hidden)
        for record in hidden if authority.is_final else ():
            self._store.discard(record.slot)

    def _list_leased(self, owner: bytes) -> list[Record]:
        """Return the leased records of ``owner`` that are stored as a replica."""
        return [
            r for r in self._store.find_owned(owner) if r.lifetime == "leased" and r.slot not in self.watched_copies
        ]

    def _sync_level(self) -> int:
        return SYNCED_REPLY if self.is_synced() else UNSYNCED_REPLY

    def _make_page(self, key: bytes, after: list[object] | None) -> tuple[list[object], list[object] | None]:
        cursor = _check_cursor(after)
        records = self.get_held(key)
        begin = bisect_right(records, cursor, key=lambda record: (record.owner, record.name)) if cursor else 0
        left = records[begin:]
        page = next(split_pages(left), [])
        following: list[object] | None = [page[-1].owner, page[-1].name] if len(page) < len(left) else None
        return [record.pack() for record in page], following

    def _notify_gone(self, records: list[Record]) -> None:
        for record in records:
            if record.slot in self.watched_copies:
                self.watched_copies.remove(record.slot)
                continue
            self.pusher.push(record.key, [], [record])
            self.on_gone(record)

    def _sweep_earlier(self) -> None:
        """Schedule the next sweep earlier if a new record expires before the scheduled sweep."""
        if self._swept_at >= 0 and self._store.next_expiry() <= self._sweep_at - SWEEP_INTERVAL_S:
            self._cancel_sweep()
            self._schedule_sweep()

    def _schedule_sweep(self) -> None:
        """Schedule the next sweep for the next expiry, rounded up to a multiple of ``SWEEP_INTERVAL_S``."""
        now, at = self._clock.seconds(), self._swept_at + SWEEP_INTERVAL_S
        due = min(self._store.next_expiry(), now + MAX_SWEEP_INTERVAL_S)
        while at < due or at <= now:
            at += SWEEP_INTERVAL_S
        self._sweep_at = at
        self._cancel_sweep = self._background.later(at - now, self._sweep)

    def _sweep(self) -> None:
        self._swept_at = self._sweep_at
        try:
            ended = self._store.expire(self._clock.seconds())
        finally:
            self._schedule_sweep()
        self._notify_gone(ended)
        for owner in dict.fromkeys(r.owner for r in ended if r.lifetime == "leased"):
            self.on_owner_expired(owner)


def split_pages(records: list[Record], most: int | None = None) -> Iterator[list[Record]]:
    """Split ``records`` into pages of about ``PAGE_BYTES`` and at most ``most`` records each."""
    page: list[Record] = []
    size = 0
    for record in records:
        size += record.message_bytes
        if page and (size > PAGE_BYTES or len(page) == most):
            yield page
            page, size = [], record.message_bytes
        page.append(record)
    if page:
        yield page


def _check_key(key: object) -> bytes:
    if not isinstance(key, bytes) or len(key) != KEY_BYTES:
        raise Refused(f"the key must have {KEY_BYTES} bytes")
    return key


def _check_cursor(after: list[object] | None) -> tuple[bytes, str] | None:
    if after is None:
        return None
    if len(after) != 2 or not isinstance(after[0], bytes) or not isinstance(after[1], str):
        raise Refused("the start of a page must be empty or an owner and a name")
    return after[0], after[1]


def _check_lifetime(life: object) -> float:
    if type(life) is not float or not math.isfinite(life):
        raise Refused("the remaining lifetime must be a finite float of seconds")
    return life
