"""Replica: what a node does for the records of others that it holds.

It answers STORE, FIND_VALUE and WATCH, keeps the leases of owners, pushes changes to watchers, and lets go of what has run
out.  It decides nothing about where records belong; ``node`` does.
"""

from __future__ import annotations

from collections.abc import Callable

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.python.failure import Failure

from middleware.entangled.background import Background
from middleware.entangled.errors import NotRunning, Refused, WeatherError
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.record import KEY_BYTES, Record, Slot, unpacked
from middleware.entangled.store import Store
from middleware.entangled.watch import digest_of
from middleware.entangled.wire.endpoint import Endpoint

WATCH_TTL = 8.0
MAX_WATCHERS = 1000
PAGE_BYTES = 1000
SWEEP = 0.1

OnRecord = Callable[[Record], None]
OnGone = Callable[[Slot], None]


class Replica:
    """The records of others, held for them.

    ``on_record`` is told of every record that was accepted, ``on_gone`` of every slot that ran out, ``on_goodbye`` of every peer
    that leaves in order.
    """

    def __init__(self, store: Store, endpoint: Endpoint, clock: IReactorTime, chores: Background) -> None:
        self._store = store
        self._endpoint = endpoint
        self._clock = clock
        self._watchers: dict[bytes, dict[bytes, tuple[Contact, float]]] = {}
        self._doubtful: set[bytes] = set()
        self.on_record: OnRecord = lambda record: None
        self.on_gone: OnGone = lambda slot: None
        self.on_goodbye: Callable[[Contact], None] = lambda contact: None
        self._chores = chores
        endpoint.expose("store", self.answer_store, changes=True)
        endpoint.expose("find_value", self.answer_find_value)
        endpoint.expose("watch", self.answer_watch)
        endpoint.expose("alive", self.answer_alive)
        endpoint.expose("goodbye", self.answer_goodbye)

    def start(self) -> None:
        """Let go of what runs out from now on."""
        self._chores.every(SWEEP, self._sweep)

    def keep(self, record: Record) -> int:
        """Hold ``record`` if it beats what its slot holds; 0 if it does, else the sequence that holds."""
        before = self._store.slot(record.slot)
        if self._store.put(record, self._clock.seconds() + record.ttl):
            self.on_record(record)
            self._push(record.key, [record.packed()], [])
            return 0
        if before is not None and before.sequence >= record.sequence and before.signature != record.signature:
            return before.sequence
        return 0

    # -- what peers ask ---------------------------------------------------------------------------------------------

    def answer_store(self, peer: Contact, packed: list[object]) -> list[int]:
        """STORE: keep records; answers for each 0, or the sequence that beats it, or -1 for a forged one."""
        answers = []
        for fields in packed:
            record = unpacked(fields)
            if record is None:
                raise Refused("not a record")
            if record.owner != peer.public and (record.lifetime == "leased" or not record.is_genuine()):
                # Only its owner may store a leased record: it shall not outlive the owner's own sign of life.
                answers.append(-1)
                continue
            answers.append(self.keep(record))
        return answers

    def answer_find_value(self, peer: Contact, key: bytes, after: list[object] | None = None) -> list[object]:
        """FIND_VALUE: a page of the records under ``key``, and where the next page begins (None: that was all)."""
        return self._page(_checked_key(key), after)

    def answer_watch(self, peer: Contact, key: bytes, digest: bytes) -> list[object] | None:
        """WATCH: push changes of ``key`` to ``peer`` for a while; None if it is up to date, else the first page."""
        watchers = self._watchers.setdefault(_checked_key(key), {})
        if peer.node_id not in watchers and len(watchers) >= MAX_WATCHERS:
            raise Refused("too many watchers of this key")
        watchers[peer.node_id] = (peer, self._clock.seconds() + WATCH_TTL)
        if digest == digest_of(self._store.get(key, tombstones=True)):
            return None
        return self._page(key, None)

    def answer_alive(self, peer: Contact, lease: float, digest: bytes) -> None:
        """ALIVE: extend the leases of ``peer``; tell it when what is held of it differs from what it says twice."""
        held = [r for r in self._store.owned(peer.public) if r.lifetime == "leased"]
        self._store.extend(peer.public, self._clock.seconds() + min(float(lease), 3600.0))
        if digest == digest_of(held):
            self._doubtful.discard(peer.node_id)
        elif peer.node_id in self._doubtful:
            self._doubtful.discard(peer.node_id)
            self._endpoint.tell(peer, "missing")
        else:
            self._doubtful.add(peer.node_id)

    def answer_goodbye(self, peer: Contact) -> None:
        """GOODBYE: the peer leaves, and what it leased leaves with it (thesis, section 4.2.2)."""
        self._gone(self._store.drop_leased(peer.public))
        for watchers in self._watchers.values():
            watchers.pop(peer.node_id, None)
        self.on_goodbye(peer)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _page(self, key: bytes, after: list[object] | None) -> list[object]:
        cursor = tuple(after) if after is not None else None
        page: list[object] = []
        size = 0
        for record in self._store.get(key, tombstones=True):
            place = (record.owner, record.name)
            if cursor is not None and place <= cursor:
                continue
            size += len(record.value or b"") + 180
            if page and size > PAGE_BYTES:
                return [page, last]
            page.append(record.packed())
            last = [record.owner, record.name]
        return [page, None]

    def _push(self, key: bytes, records: list[object], gone: list[object]) -> None:
        watchers = self._watchers.get(key)
        if not watchers:
            return
        now = self._clock.seconds()
        for watcher_id, (watcher, until) in list(watchers.items()):
            if until < now:
                del watchers[watcher_id]
                continue
            pushed: Deferred[object] = self._endpoint.ask(watcher, "push", key, records, gone, changes=True)
            pushed.addErrback(_ignore_weather)

    def _gone(self, records: list[Record]) -> None:
        for record in records:
            self.on_gone(record.slot)
            self._push(record.key, [], [[record.owner, record.name]])

    def _sweep(self) -> None:
        self._gone(self._store.expire(self._clock.seconds()))


def _checked_key(key: object) -> bytes:
    if not isinstance(key, bytes) or len(key) != KEY_BYTES:
        raise Refused(f"a key has {KEY_BYTES} bytes")
    return key


def _ignore_weather(failure: Failure) -> None:
    failure.trap(WeatherError, Refused, NotRunning)

