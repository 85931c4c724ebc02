"""Pusher: tells those who watch a key what changes here.

Soft state: a watcher counts for some seconds after it last asked, ``WATCH_TTL`` where it names no others.  Pushes to
one watcher of one key are numbered without a gap, so that it notices what it missed, and asks again.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.python.failure import Failure

from middleware.entangled.background import Background
from middleware.entangled.contact import Contact
from middleware.entangled.errors import NotRunning, Refused, WeatherError
from middleware.entangled.record import Record, Slot
from middleware.entangled.wire.endpoint import Endpoint

WATCH_TTL, MAX_TTL = 8.0, 60.0
MAX_WATCHERS = 1000
FEW, GATHERED = 64, 0.1
"""Watchers of a key up to which each change is pushed by itself, and seconds for which they are gathered beyond."""
PUSH_BYTES, MOST_GONE = 12_000, 100
"""What one push of several changes carries, about."""
MAX_WATCHED = 10_000
"""Keys that are watched here at the same time."""


@dataclass(slots=True)
class _Watcher:
    """Who watches, until when, and the number of the last push to it."""

    contact: Contact
    until: float
    number: int = 0


class Pusher:
    """The watchers of the keys that one replica holds."""

    def __init__(self, endpoint: Endpoint, clock: IReactorTime, chores: Background) -> None:
        self._endpoint = endpoint
        self._clock = clock
        self._chores = chores
        self._watchers: dict[bytes, dict[bytes, _Watcher]] = {}
        self._gathered: dict[bytes, dict[Slot, tuple[Record, bool]]] = {}

    def start(self) -> None:
        """Forget who does not ask again, from now on."""
        self._chores.every(WATCH_TTL, self._prune)

    def watched(self, key: bytes, peer: Contact, ttl: float = WATCH_TTL) -> int:
        """``peer`` watches ``key`` from now on; the number of the last push to it.  Raises ``Refused``."""
        if not 0.0 < ttl <= MAX_TTL:
            raise Refused(f"a watch counts for up to {MAX_TTL:g} s")
        watchers = self._watchers.get(key, {})
        is_full = len(watchers) >= MAX_WATCHERS or (not watchers and len(self._watchers) >= MAX_WATCHED)
        if peer.node_id not in watchers and is_full:
            raise Refused("too many watchers of this key")
        until = self._clock.seconds() + ttl
        watcher = watchers.setdefault(peer.node_id, _Watcher(peer, until))
        watcher.contact, watcher.until = peer, until
        self._watchers[key] = watchers
        return watcher.number

    def push(self, key: bytes, records: Iterable[Record], gone: Iterable[Record]) -> None:
        """Tell the watchers of ``key`` that ``records`` are held now, and those in ``gone`` no longer."""
        watchers = self._watchers.get(key)
        if not watchers:
            return
        if len(watchers) <= FEW and key not in self._gathered:
            self._push(key, [record.packed() for record in records], [[record.owner, record.name] for record in gone])
            return
        if key not in self._gathered:
            self._chores.later(GATHERED, self._push_gathered, key)
        # Of each slot the last word only: it was there and went, or went and is there again.
        words = self._gathered.setdefault(key, {})
        words.update((record.slot, (record, True)) for record in records)
        words.update((record.slot, (record, False)) for record in gone)

    def _push_gathered(self, key: bytes) -> None:
        packed: list[object] = []
        places: list[object] = []
        size = 0
        for record, is_there in self._gathered.pop(key).values():
            if is_there:
                packed.append(record.packed())
                size += record.message_bytes
            else:
                places.append([record.owner, record.name])
            if size > PUSH_BYTES or len(places) >= MOST_GONE:
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
            pushed.addErrback(_ignore_weather)

    def forget(self, peer: Contact) -> None:
        """``peer`` left."""
        for watchers in self._watchers.values():
            watchers.pop(peer.node_id, None)

    def _prune(self) -> None:
        now = self._clock.seconds()
        for key, watchers in list(self._watchers.items()):
            for watcher_id in [w for w, watcher in watchers.items() if watcher.until < now]:
                del watchers[watcher_id]
            if not watchers:
                del self._watchers[key]


def _ignore_weather(failure: Failure) -> None:
    failure.trap(WeatherError, Refused, NotRunning)
