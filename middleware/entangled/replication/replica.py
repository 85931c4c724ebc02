"""Replica: what a node does for the records of others that it holds.

It answers STORE and FIND_VALUE, keeps the leases of owners, tells ``pusher`` what changes, and lets go of what has
run out.  It decides nothing about where records belong; ``overlay`` does.
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
from middleware.entangled.record import KEY_BYTES, Record, Signed, Slot, unpacked
from middleware.entangled.replication.cache import PathCache
from middleware.entangled.replication.certificates import Certificates
from middleware.entangled.replication.keepsake import Keepsakes
from middleware.entangled.replication.pusher import WATCH_TTL, Pusher
from middleware.entangled.replication.store_reply import STORED, UNSYNCED, Outcome, StoreReply
from middleware.entangled.replication.watch import digest_of
from middleware.entangled.wire.door import Authority
from middleware.entangled.wire.endpoint import Endpoint

PAGE_BYTES = 12_000
"""A page of small records goes out in one burst: ten datagrams are the first window of a parcel."""
SWEEP, LONGEST_SWEEP = 0.1, 60.0
"""Seconds between two looks for what ran out, and those after which is looked though nothing can have."""
MAX_LEASE = 3600.0
MARKS = 100
MAX_DOUBTFUL = 4096
"""Leased records that are named in one message."""

UNSURE, SURE, CACHED = 0, 1, 2
"""What an answer is worth: of a replica that has yet to catch up, of one that has, a copy from the path."""


class Replica:
    """The records of others, held for them; ``keepsakes`` are the node's own copies, which nobody else gets to see.

    ``may_store`` says whether the owner of a slot may write there, by its certificate as it is at present, ``may_stay``
    whether what is held there may be held on and shown; that is the same but for few slots.  ``is_sure`` says whether
    this node has caught up with the others.

    ``on_record`` is told of every record that was accepted, ``on_gone`` of every one that is let go of, ``on_silent``
    of every owner (its public key) whose lease ran out or that said goodbye.
    """

    def __init__(
        self, store: Store, endpoint: Endpoint, overlay: Overlay, clock: IReactorTime, chores: Background
    ) -> None:
        self.keepsakes = Keepsakes(store)
        self._store = store
        self._endpoint = endpoint
        self._overlay = overlay
        self._clock = clock
        self.pusher = Pusher(endpoint, clock, chores)
        self.cache = PathCache()
        self._signed = Signed()
        self.certificates = Certificates(endpoint, clock)
        self.may_store: Callable[[Slot], bool] = endpoint.door.may_store
        self.may_stay: Callable[[Slot], bool] = endpoint.door.may_stay
        self._authorities: dict[bytes, Authority] = {}
        self.is_sure: Callable[[], bool] = lambda: True
        self._doubtful: set[bytes] = set()
        self._swept_at = self._sweep_at = -1.0
        self._no_sweep: Callable[[], None] = lambda: None
        self.on_record = Listeners[[Record]]()
        self.on_gone = Listeners[[Record]]()
        self.on_silent = Listeners[[bytes]]()
        self._chores = chores
        endpoint.expose("store", self._once_written(self.answer_store), changes=True, idempotent=True)
        endpoint.expose("find_value", self.answer_find_value, early=True)
        endpoint.expose("cache", self.answer_cache, changes=True, idempotent=True)
        endpoint.expose("watch", self.answer_watch, changes=True, idempotent=True)
        endpoint.expose("alive", self.answer_alive, changes=True, idempotent=True)
        endpoint.expose("let_go", self.answer_let_go, changes=True, idempotent=True)
        endpoint.expose("goodbye", self.answer_goodbye, changes=True)

    def start(self) -> None:
        """Let go of what runs out from now on."""
        self._swept_at = self._clock.seconds()
        self._sweep_later()
        self.pusher.start()

    def held(self, key: bytes) -> list[Record]:
        """What is held under ``key`` as a replica, tombstones included."""
        kept = self.keepsakes.under(key)
        return [r for r in self._store.get(key, tombstones=True) if r.slot not in kept and self.may_stay(r.slot)]

    def shown(self, slot: Slot) -> Record | None:
        """What the slot holds as a replica, for others to see."""
        return None if slot in self.keepsakes or not self.may_stay(slot) else self._store.slot(slot)

    def team_records(self) -> list[Record]:
        """The team records that are held as a replica, tombstones included, for others to see."""
        kept = self.keepsakes
        return [
            r for r in self._store.records() if r.lifetime == "team" and r.slot not in kept and self.may_stay(r.slot)
        ]

    def holds(self, record: Record) -> bool:
        """Whether this very record is held as a replica."""
        return self._store.slot(record.slot) == record and record.slot not in self.keepsakes

    def keep(self, record: Record, left: float | None = None) -> StoreReply:
        """Hold ``record`` if it beats what its slot holds: STORED, or SUPERSEDED.

        It is held for ``left`` seconds, as long as whoever handed it on would have; by default a whole ttl.
        """
        self.keepsakes.release(record.slot)
        self.cache.drop(record.key)
        before = self._store.slot(record.slot)
        life = record.ttl if left is None else min(left, record.ttl)
        if self._store.put(record, self._clock.seconds() + life):
            self._sweep_in_time()
            self.on_record(record)
            self.pusher.push(record.key, [record], [])
        elif before is not None and before.sequence >= record.sequence and before.signature != record.signature:
            return StoreReply(Outcome.SUPERSEDED, before.sequence)
        return STORED

    def store(self, record: Record, left: float | None = None) -> StoreReply:
        """Hold ``record`` as ``keep`` does; UNSYNCED instead of STORED if this replica is not sure."""
        reply = self.keep(record, left)
        return UNSYNCED if reply is STORED and not self.is_sure() else reply

    def left(self, record: Record) -> float:
        """Seconds for which ``record`` is still held here; its ttl where it is not."""
        expiry = self._store.expiry(record.slot)
        return record.ttl if expiry is None else expiry - self._clock.seconds()

    def review(self) -> bool:
        """Judge the held records of those owners whose authority has changed; whether that was any.

        What an owner may not write is gone for those who watch.  It is dropped where that is final; where only a clock
        or a certificate that is missing stands against it, it is not shown until it may be, or runs out.
        """
        before, door = self._authorities, self.certificates.door
        self._authorities = {owner: door.authority(owner) for owner in self._store.owners()}
        changed = [owner for owner, authority in self._authorities.items() if before.get(owner) != authority]
        for owner in changed:
            self._judge(owner, self._authorities[owner], before.get(owner))
        return bool(changed)

    # -- what peers ask ---------------------------------------------------------------------------------------------

    def answer_store(
        self, peer: Contact, packed: list[object], left: list[object] | None = None
    ) -> list[int] | Deferred[list[int]]:
        """STORE: keep records; answers the code of a ``StoreReply`` for each.

        ``left`` are the seconds that each is to be kept, where it does not come from its owner.  The peer is asked for
        certificates that are not known here.
        """
        self._overlay.heard(peer)
        records = [record for record in map(unpacked, packed) if record is not None]
        lives = [None] * len(packed) if left is None else [_checked_life(life) for life in left]
        if len(records) < len(packed) or len(lives) != len(packed):
            raise Refused("not a record")
        owners = [record.owner for record in records]
        if self.certificates.lacking(peer, owners):
            learnt = Deferred.fromCoroutine(self.certificates.learn(peer, owners))
            return learnt.addCallback(lambda _: self._stored(peer, records, lives))
        return self._stored(peer, records, lives)

    def answer_find_value(
        self,
        peer: Contact,
        key: bytes,
        after: list[object] | None = None,
        wants_sure: bool = False,
        digest: bytes = b"",
    ) -> list[object]:
        """FIND_VALUE: a page of the records under ``key``, where the next page begins (None: that was all), its worth.

        Where nothing is held, the contacts that are closest to the key follow, and a copy from the path may be given
        unless ``wants_sure``.  Whose way leads past a node that is not one of the closest gets these contacts too: what
        is held there, such as the node's own record, may be all that was not let go of.  Where ``digest`` is that of
        all that is held, None stands for the records.
        """
        if digest and digest == digest_of(self.held(_checked_key(key))):
            return [None, None, self._worth()]
        page, following = self._page(_checked_key(key), after)
        is_nothing = not page and after is None
        cached = self.cache.get(key, self._clock.seconds()) if is_nothing and not wants_sure else None
        if cached:
            return [[record.packed() for record in cached if self.may_store(record.slot)], None, CACHED]
        is_aside = not is_nothing and not wants_sure and not self._overlay.is_responsible(key)
        if not (is_nothing or is_aside):
            return [page, following, self._worth()]
        near = [contact.packed() for contact in self._overlay.nearest(key) if contact.node_id != peer.node_id]
        return [page, following, UNSURE if is_aside else self._worth(), near]

    def answer_cache(self, peer: Contact, key: bytes, packed: list[object], ttl: float) -> None:
        """CACHE: keep a copy of what a lookup found, for those whose way leads past here (Kademlia, section 2.3)."""
        records = [record for record in map(unpacked, packed) if record is not None]
        if len(records) < len(packed) or any(record.key != _checked_key(key) for record in records):
            raise Refused("not records of this key")
        if not self.held(key) and all(self.is_genuine(record) for record in records):
            self.cache.put(key, records, ttl, self._clock.seconds())

    def answer_watch(self, peer: Contact, key: bytes, digest: bytes, ttl: float = WATCH_TTL) -> list[object]:
        """WATCH: push changes of ``key`` to ``peer`` for ``ttl`` seconds, a minute at most.

        Answers the number of the last push, and the first page (None where ``digest`` is that of what is held).
        """
        self._overlay.heard(peer)
        number = self.pusher.watched(_checked_key(key), peer, ttl)
        return [number, None if digest == digest_of(self.held(key)) else list(self._page(key, None))]

    def answer_alive(self, peer: Contact, lease: float, digest: bytes) -> None:
        """ALIVE: extend the leases of ``peer``; where what is held differs from what it says twice, tell it.

        Where nothing is held, they have run out here though the peer lives: it is told at once.
        """
        self._overlay.heard(peer)
        held = self._leased(peer.public)
        self._store.extend(peer.public, self._clock.seconds() + min(float(lease), MAX_LEASE))
        if digest == digest_of(held):
            self._doubtful.discard(peer.node_id)
        elif peer.node_id in self._doubtful or not held:
            self._doubtful.discard(peer.node_id)
            self._endpoint.tell(peer, "missing", [digest_of([r]) for r in held[:MARKS]])
        else:
            if len(self._doubtful) >= MAX_DOUBTFUL:
                self._doubtful.clear()  # these are told one sign later
            self._doubtful.add(peer.node_id)

    def answer_let_go(self, peer: Contact, marks: list[object]) -> None:
        """LET_GO: these leased records of ``peer`` (a digest each) do not belong here any more."""
        self._gone([r for r in self._leased(peer.public) if digest_of([r]) in marks and self._store.discard(r.slot)])

    def answer_goodbye(self, peer: Contact) -> None:
        """GOODBYE: the peer leaves, and what it leased leaves with it (thesis, section 4.2.2)."""
        self._gone(self._store.drop_leased(peer.public))
        self.on_silent(peer.public)
        self.pusher.forget(peer)
        self._doubtful.discard(peer.node_id)
        self._overlay.left(peer)

    def _refusal(self, record: Record, peer: Contact) -> StoreReply | None:
        if not self.may_store(record.slot):
            return StoreReply(Outcome.FORBIDDEN)
        return None if self.is_lawful(record, peer) else StoreReply(Outcome.FORGED)

    def is_lawful(self, record: Record, peer: Contact) -> bool:
        """Whether ``peer`` may store ``record``.

        Its owner's own session vouches for it; second-hand a signature has to, and a lease is taken from its owner
        only, for it shall not outlive the owner's own sign of life.
        """
        return record.owner == peer.public or (record.lifetime == "team" and self.is_genuine(record))

    def is_genuine(self, record: Record) -> bool:
        """Whether ``record`` is its owner's own word, and one that it may give.

        So is the very one that is held here, and one with a good signature.
        """
        return self.may_store(record.slot) and (self.holds(record) or self._signed.is_genuine(record))

    # -- inside -----------------------------------------------------------------------------------------------------

    def _once_written(
        self, answer: Callable[..., list[int] | Deferred[list[int]]]
    ) -> Callable[..., Deferred[list[int]]]:
        """``answer``, given only when what it took would survive the end of this process."""

        def written(answers: list[int]) -> Deferred[list[int]]:
            return self._store.written().addCallback(lambda _: answers)

        @wraps(answer)
        def acknowledged(*arguments: object) -> Deferred[list[int]]:
            answers = answer(*arguments)
            return answers.addCallback(written) if isinstance(answers, Deferred) else written(answers)

        return acknowledged

    def _stored(self, peer: Contact, records: list[Record], lives: Sequence[float | None]) -> list[int]:
        """Keep those of ``records`` that are lawful; one whose owner has too many does not keep the others out."""
        replies = []
        for record, life in zip(records, lives, strict=True):
            try:
                replies.append(self._refusal(record, peer) or self.store(record, life))
            except Full as error:
                if len(records) == 1 or error.code != OWNER_FULL:
                    raise
                replies.append(StoreReply(Outcome.NO_ROOM))
        return [reply.encode() for reply in replies]

    def _judge(self, owner: bytes, authority: Authority, before: Authority | None) -> None:
        """Let go of what ``owner`` may not write now, or show again what it may."""
        out = []
        for record in self._store.owned(owner):
            if not self.may_stay(record.slot):
                out.append(record)
            elif before is not None and before.refusal and record.slot not in self.keepsakes:
                self.on_record(record)
                self.pusher.push(record.key, [record], [])
        self._gone(out)
        for record in out if authority.is_final else ():
            self._store.discard(record.slot)

    def _leased(self, owner: bytes) -> list[Record]:
        """What is held of ``owner`` on lease."""
        return [r for r in self._store.owned(owner) if r.lifetime == "leased" and r.slot not in self.keepsakes]

    def _worth(self) -> int:
        return SURE if self.is_sure() else UNSURE

    def _page(self, key: bytes, after: list[object] | None) -> tuple[list[object], list[object] | None]:
        cursor = _checked_cursor(after)
        records = self.held(key)
        begin = bisect_right(records, cursor, key=lambda record: (record.owner, record.name)) if cursor else 0
        left = records[begin:]
        page = next(pages_of(left), [])
        following: list[object] | None = [page[-1].owner, page[-1].name] if len(page) < len(left) else None
        return [record.packed() for record in page], following

    def _gone(self, records: list[Record]) -> None:
        for record in records:
            if record.slot in self.keepsakes:
                self.keepsakes.release(record.slot)
                continue
            self.pusher.push(record.key, [], [record])
            self.on_gone(record)

    def _sweep_in_time(self) -> None:
        """Sweep earlier than was thought, where something that was taken in runs out sooner."""
        if self._swept_at >= 0 and self._store.due() <= self._sweep_at - SWEEP:
            self._no_sweep()
            self._sweep_later()

    def _sweep_later(self) -> None:
        """Sweep in a multiple of ``SWEEP``: as soon as something may have run out."""
        now, at = self._clock.seconds(), self._swept_at + SWEEP
        due = min(self._store.due(), now + LONGEST_SWEEP)
        while at < due or at <= now:
            at += SWEEP
        self._sweep_at = at
        self._no_sweep = self._chores.later(at - now, self._sweep)

    def _sweep(self) -> None:
        self._swept_at = self._sweep_at
        try:
            ended = self._store.expire(self._clock.seconds())
        finally:
            self._sweep_later()
        self._gone(ended)
        for owner in dict.fromkeys(r.owner for r in ended if r.lifetime == "leased"):
            self.on_silent(owner)


def pages_of(records: list[Record], most: int | None = None) -> Iterator[list[Record]]:
    """``records``, in order, in pages of about ``PAGE_BYTES`` and at most ``most`` each."""
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


def _checked_life(life: object) -> float:
    if type(life) is not float or not math.isfinite(life):
        raise Refused("what is left of a life is a number of seconds")
    return life
