"""Notification of watchers: pushes changes of a key to the peers that watch it.

Watchers are soft state: each request to watch is valid for the seconds in the request, by default ``WATCH_TTL_S``.
Pushes to one watcher of one key are numbered without gaps, so the watcher detects a missed push and requests the
records again.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.python.failure import Failure

from middleware.entangled.background import Background
from middleware.entangled.contact import Contact
from middleware.entangled.errors import NotRunning, Refused, TransientError
from middleware.entangled.record import Record, Slot
from middleware.entangled.wire.endpoint import Endpoint

WATCH_TTL_S, MAX_WATCH_TTL_S = 8.0, 60.0
MAX_WATCHERS = 1000
MAX_IMMEDIATE, BATCH_DELAY_S = 64, 0.1
"""The number of watchers of a key up to which each change is pushed immediately.  With more watchers, the changes
within the second number of seconds share a push."""
PUSH_BYTES, MAX_REMOVED = 12_000, 100
"""The approximate maximum of bytes, and the maximum number of removed slots, in one push of several changes."""
MAX_KEYS = 10_000
"""The maximum number of keys that have watchers at the same time."""


@dataclass(slots=True)
class _Watcher:
    """A watcher, the time when its watch expires, and the number of the last push to it."""

    contact: Contact
    until: float
    number: int = 0


class Pusher:
    """The watchers of the keys for which one node is a replica."""

    def __init__(self, endpoint: Endpoint, clock: IReactorTime, background: Background) -> None:
        self._endpoint = endpoint
        self._clock = clock
        self._background = background
        self._watchers: dict[bytes, dict[bytes, _Watcher]] = {}
        self._batches: dict[bytes, dict[Slot, tuple[Record, bool]]] = {}

    def start(self) -> None:
        """Start to remove expired watchers periodically."""
        self._background.every(WATCH_TTL_S, self._prune)

    def add_watcher(self, key: bytes, peer: Contact, ttl: float = WATCH_TTL_S) -> int:
        """Add or renew a watcher of ``key``; return the number of the last push to it.  Raises ``Refused``."""
        if not 0.0 < ttl <= MAX_WATCH_TTL_S:
            raise Refused(f"the duration of a watch must be more than 0 and at most {MAX_WATCH_TTL_S:g} s")
        watchers = self._watchers.get(key, {})
        is_full = len(watchers) >= MAX_WATCHERS or (not watchers and len(self._watchers) >= MAX_KEYS)
        if peer.node_id not in watchers and is_full:
            raise Refused("this replica has too many watchers; try again later")
        until = self._clock.seconds() + ttl
        watcher = watchers.setdefault(peer.node_id, _Watcher(peer, until))
        watcher.contact, watcher.until = peer, until
        self._watchers[key] = watchers
        return watcher.number

    def push(self, key: bytes, records: Iterable[Record], gone: Iterable[Record]) -> None:
        """Notify the watchers of ``key`` that this node now stores ``records``, and no longer those in ``gone``."""
        watchers = self._watchers.get(key)
        if not watchers:
            return
        if len(watchers) <= MAX_IMMEDIATE and key not in self._batches:
            self._push(key, [record.pack() for record in records], [[record.owner, record.name] for record in gone])
            return
        if key not in self._batches:
            self._background.later(BATCH_DELAY_S, self._push_batch, key)
        # Only the last change of each slot is pushed.
        changes = self._batches.setdefault(key, {})
        changes.update((record.slot, (record, True)) for record in records)
        changes.update((record.slot, (record, False)) for record in gone)

    def _push_batch(self, key: bytes) -> None:
        packed: list[object] = []
        places: list[object] = []
        size = 0
        for record, is_there in self._batches.pop(key).values():
            if is_there:
                packed.append(record.pack())
                size += record.message_bytes
            else:
                places.append([record.owner, record.name])
            if size > PUSH_BYTES or len(places) >= MAX_REMOVED:
                self._push(key, packed, places)
                packed, places, size = [], [], 0
        if packed or places:
            self._push(key, packed, places)

    def _push(self, key: bytes, packed: list[object], places: list[object]) -> None:
        now = self._clock.seconds()
        watchers = self._watchers.get(key, {})
        for watcher in list(watchers.values()):
            if watcher.until < now:
                del watchers[watcher.contact.node_id]
                continue
            watcher.number += 1
            pushed: Deferred[object] = self._endpoint.ask(
                watcher.contact, "push", key, watcher.number, packed, places, changes=True
            )
            pushed.addErrback(_ignore_transient)

    def forget(self, peer: Contact) -> None:
        """Remove ``peer``, which left the network, from all keys."""
        for watchers in self._watchers.values():
            watchers.pop(peer.node_id, None)

    def _prune(self) -> None:
        now = self._clock.seconds()
        for key, watchers in list(self._watchers.items()):
            for watcher_id in [w for w, watcher in watchers.items() if watcher.until < now]:
                del watchers[watcher_id]
            if not watchers:
                del self._watchers[key]


def _ignore_transient(failure: Failure) -> None:
    failure.trap(TransientError, Refused, NotRunning)
