"""Replica: what a node does for the records of others that it holds.

It answers STORE, FIND_VALUE and WATCH, keeps the leases of owners, pushes changes to watchers, and lets go of what
has run out.  It decides nothing about where records belong; ``node`` does.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.python.failure import Failure

from middleware.entangled.background import Background
from middleware.entangled.errors import NotRunning, Refused, WeatherError
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.keepsake import Keepsakes
from middleware.entangled.record import KEY_BYTES, Record, unpacked
from middleware.entangled.store import Store
from middleware.entangled.watch import digest_of
from middleware.entangled.wire.endpoint import Endpoint

WATCH_TTL = 8.0
MAX_WATCHERS = 1000
MAX_WATCHED = 10_000
"""Keys that are watched here at the same time."""
PAGE_BYTES = 12_000
"""A page of small records goes out in one burst: ten datagrams are the first window of a parcel."""
RECORD_BYTES = 160
"""What a record weighs in a message beside its name and value."""
SWEEP = 0.1
MAX_LEASE = 3600.0
MARKS = 100
"""Leased records that are named in one message."""

OnRecord = Callable[[Record], None]


class Replica:
    """The records of others, held for them; ``keepsakes`` are the node's own copies, which nobody else gets to see.

    ``on_record`` is told of every record that was accepted, ``on_gone`` of every one that is let go of, ``on_silent``
    of every owner (its public key) whose lease ran out or that said goodbye, ``on_peer`` of every peer that stores,
    watches or is alive, ``on_goodbye`` of every peer that leaves in order.
    """

    def __init__(self, store: Store, endpoint: Endpoint, clock: IReactorTime, chores: Background) -> None:
        self.keepsakes = Keepsakes(store)
        self._store = store
        self._endpoint = endpoint
        self._clock = clock
        self._watchers: dict[bytes, dict[bytes, tuple[Contact, float]]] = {}
        self._doubtful: set[bytes] = set()
        self.on_record: OnRecord = lambda record: None
        self.on_gone: OnRecord = lambda record: None
        self.on_silent: Callable[[bytes], None] = lambda owner: None
        self.on_peer: Callable[[Contact], None] = lambda contact: None
        self.on_goodbye: Callable[[Contact], None] = lambda contact: None
        self._chores = chores
        endpoint.expose("store", self._once_written(self.answer_store), changes=True)
        endpoint.expose("find_value", self.answer_find_value)
        endpoint.expose("watch", self.answer_watch, changes=True)
        endpoint.expose("alive", self.answer_alive, changes=True)
        endpoint.expose("let_go", self.answer_let_go, changes=True)
        endpoint.expose("goodbye", self.answer_goodbye, changes=True)

    def start(self) -> None:
        """Let go of what runs out from now on."""
        self._chores.every(SWEEP, self._sweep)
        self._chores.every(WATCH_TTL, self._prune)

    def held(self, key: bytes) -> list[Record]:
        """What is held under ``key`` as a replica, tombstones included."""
        return [r for r in self._store.get(key, tombstones=True) if r.slot not in self.keepsakes]

    def keep(self, record: Record) -> int:
        """Hold ``record`` if it beats what its slot holds; 0 if it does, else the sequence that holds."""
        self.keepsakes.release(record.slot)
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
        self.on_peer(peer)
        records = [record for record in map(unpacked, packed) if record is not None]
        if len(records) < len(packed):
            raise Refused("not a record")
        return [self.keep(record) if _is_lawful(record, peer) else -1 for record in records]

    def answer_find_value(self, peer: Contact, key: bytes, after: list[object] | None = None) -> list[object]:
        """FIND_VALUE: a page of the records under ``key``, and where the next page begins (None: that was all)."""
        return self._page(_checked_key(key), after)

    def answer_watch(self, peer: Contact, key: bytes, digest: bytes) -> list[object] | None:
        """WATCH: push changes of ``key`` to ``peer`` for a while; None if it is up to date, else the first page."""
        self.on_peer(peer)
        watchers = self._watchers.get(_checked_key(key), {})
        is_full = len(watchers) >= MAX_WATCHERS or (not watchers and len(self._watchers) >= MAX_WATCHED)
        if peer.node_id not in watchers and is_full:
            raise Refused("too many watchers of this key")
        watchers[peer.node_id] = (peer, self._clock.seconds() + WATCH_TTL)
        self._watchers[key] = watchers
        if digest == digest_of(self.held(key)):
            return None
        return self._page(key, None)

    def answer_alive(self, peer: Contact, lease: float, digest: bytes) -> None:
        """ALIVE: extend the leases of ``peer``; where what is held differs from what it says twice, tell it."""
        self.on_peer(peer)
        held = self._leased(peer.public)
        self._store.extend(peer.public, self._clock.seconds() + min(float(lease), MAX_LEASE))
        if digest == digest_of(held):
            self._doubtful.discard(peer.node_id)
        elif peer.node_id in self._doubtful:
            self._doubtful.discard(peer.node_id)
            self._endpoint.tell(peer, "missing", [digest_of([r]) for r in held[:MARKS]])
        else:
            self._doubtful.add(peer.node_id)

    def answer_let_go(self, peer: Contact, marks: list[object]) -> None:
        """LET_GO: these leased records of ``peer`` (a digest each) do not belong here any more."""
        self._gone([r for r in self._leased(peer.public) if digest_of([r]) in marks and self._store.discard(r.slot)])

    def answer_goodbye(self, peer: Contact) -> None:
        """GOODBYE: the peer leaves, and what it leased leaves with it (thesis, section 4.2.2)."""
        self._gone(self._store.drop_leased(peer.public))
        self.on_silent(peer.public)
        for watchers in self._watchers.values():
            watchers.pop(peer.node_id, None)
        self._doubtful.discard(peer.node_id)
        self.on_goodbye(peer)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _once_written(self, answer: Callable[..., list[int]]) -> Callable[..., Deferred[list[int]]]:
        """``answer``, given only when what it took would survive the end of this process."""

        @wraps(answer)
        def acknowledged(*arguments: object) -> Deferred[list[int]]:
            answers = answer(*arguments)
            return self._store.written().addCallback(lambda _: answers)

        return acknowledged

    def _leased(self, owner: bytes) -> list[Record]:
        """What is held of ``owner`` on lease."""
        return [r for r in self._store.owned(owner) if r.lifetime == "leased" and r.slot not in self.keepsakes]

    def _page(self, key: bytes, after: list[object] | None) -> list[object]:
        cursor = _checked_cursor(after)
        page: list[object] = []
        last: list[object] | None = None
        size = 0
        for record in self.held(key):
            if cursor is not None and (record.owner, record.name) <= cursor:
                continue
            size += len(record.value or b"") + len(record.name.encode()) + RECORD_BYTES
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
            if record.slot in self.keepsakes:
                self.keepsakes.release(record.slot)
                continue
            self._push(record.key, [], [[record.owner, record.name]])
            self.on_gone(record)

    def _sweep(self) -> None:
        ended = self._store.expire(self._clock.seconds())
        self._gone(ended)
        for owner in dict.fromkeys(r.owner for r in ended if r.lifetime == "leased"):
            self.on_silent(owner)

    def _prune(self) -> None:
        """Forget the watchers that did not ask again."""
        now = self._clock.seconds()
        for key, watchers in list(self._watchers.items()):
            for watcher_id in [w for w, (_, until) in watchers.items() if until < now]:
                del watchers[watcher_id]
            if not watchers:
                del self._watchers[key]


def _is_lawful(record: Record, peer: Contact) -> bool:
    # Only its owner may store a leased record: it shall not outlive the owner's own sign of life.  The owner's session
    # vouches for it; a team record goes from hand to hand and needs a signature that anybody can check.
    return record.owner == peer.public if record.lifetime == "leased" else record.is_genuine()


def _checked_key(key: object) -> bytes:
    if not isinstance(key, bytes) or len(key) != KEY_BYTES:
        raise Refused(f"a key has {KEY_BYTES} bytes")
    return key


def _checked_cursor(after: list[object] | None) -> tuple[bytes, str] | None:
    if after is None:
        return None
    if len(after) != 2 or not isinstance(after[0], bytes) or not isinstance(after[1], str):
        raise Refused("a page begins after an owner and a name")
    return after[0], after[1]


def _ignore_weather(failure: Failure) -> None:
    failure.trap(WeatherError, Refused, NotRunning)
