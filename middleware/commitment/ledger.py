"""Ledger: what an acceptor keeps in the store, so that no restart lets a token fall or an old promise be forgotten.

Tasks lie in buckets, each a note of the store.  What is forgotten to make room leaves a floor under tokens and ballots.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

import msgpack

from middleware.commitment.ballot import FIRST, NONE, Ballot, Ceiling, is_number, members_of
from middleware.commitment.charter import MAX_BYTES
from middleware.entangled.data.store import Store
from middleware.entangled.kademlia.contact import Contact

BUCKETS = 64
MAX_TASKS = 4096
LOOKED_AT = 64
"""The oldest entries that are looked at when there is no room for a new one; all of them would take too long."""
ENDED_AGE, IDLE_AGE = 600.0, 86_400.0
"""Seconds after which an entry may go that nobody has touched: of a task that has ended, and of any other."""
_STATE = "lease/state"


@dataclass(slots=True)
class Entry:
    """What an acceptor knows of one task.

    ``promised`` is the highest ballot answered, ``ballot`` that of the lease, which runs ``ttl`` seconds ``until`` then
    (its ``agent`` holds it); ``spent`` is the highest ballot whose lease was given back, by an agent whose robot comes
    to rest until ``until``.  ``token`` never falls; ``grantee`` is the agent to which this member granted it, empty
    where it only heard of it.
    ``sealed`` is the ballot under which ``members`` were accepted as the next council; where it is none they are the
    present one, as far as known, and ``charter`` is the proof of that.  ``ceiling`` bounds the numbers that are taken.
    """

    configuration: int = FIRST
    promised: Ballot = NONE
    ballot: Ballot = NONE
    token: int = 0
    grantee: str = ""
    ttl: float = 0.0
    spent: Ballot = NONE
    sealed: Ballot = NONE
    members: tuple[Contact, ...] = ()
    is_over: bool = False
    charter: bytes = b""
    ceiling: Ceiling = field(default_factory=lambda: Ceiling(0.0))
    until: float = 0.0
    touched_at: float = 0.0
    listeners: dict[str, float] = field(default_factory=dict)

    @property
    def is_given_back(self) -> bool:
        """Whether whoever held the lease acts no more: what may still move is its robot, until it is at rest."""
        return self.ballot <= self.spent

    def hear_token(self, token: int, agent: str = "") -> None:
        """Take note of a token that others granted, to ``agent`` where that is known; tokens never fall."""
        if token > self.token:
            self.token, self.grantee = token, agent

    def packed(self) -> list[object]:
        """The entry as it stands in a note; moments mean nothing to a later life and stay behind."""
        ballots = [*self.promised, *self.ballot, *self.spent, *self.sealed]
        members = [member.packed() for member in self.members]
        return [self.configuration, ballots, self.token, self.ttl, members, self.is_over, self.charter, self.grantee]


class Ledger:
    """The entries of one acceptor, in memory and, where there is a ``store``, in that.

    ``is_whole`` says that nothing promised in an earlier life is missing: answers wait for ``Store.written``.
    """

    def __init__(self, store: Store | None = None, now: float = 0.0) -> None:
        self.is_whole = False
        self.floor = NONE
        self.token = 0
        self.longest = 0.0
        self._store = store
        self._entries: dict[str, Entry] = {}
        self._buckets: dict[int, dict[str, None]] = {}
        if store is not None:
            self._load(store, now)
            self._keep_state()

    def __len__(self) -> int:
        return len(self._entries)

    def get(self, task_id: str) -> Entry | None:
        """What is known of a task."""
        return self._entries.get(task_id)

    def add(self, task_id: str, configuration: int, now: float) -> Entry | None:
        """A new entry, its numbers above everything forgotten; None where there is no room."""
        if len(self._entries) >= MAX_TASKS and not self._make_room(now):
            return None
        ceiling = Ceiling(now, self.floor, self.token)
        entry = Entry(configuration, promised=self.floor, token=self.token, ceiling=ceiling, touched_at=now)
        self._enter(task_id, entry)
        return entry

    def keep(self, task_id: str) -> None:
        """Note the entry of a task as it is now."""
        entry = self._entries[task_id]
        if entry.ttl > self.longest:
            self.longest = entry.ttl
            self._keep_state()
        self._note(_bucket(task_id))

    def _enter(self, task_id: str, entry: Entry) -> None:
        self._entries[task_id] = entry
        self._buckets.setdefault(_bucket(task_id), {})[task_id] = None

    def _make_room(self, now: float) -> bool:
        """Forget old entries that can harm nobody: leases that ran out long ago, or of tasks that have ended."""
        for task_id in list(self._entries)[:LOOKED_AT]:
            entry = self._entries[task_id]
            age = ENDED_AGE if entry.is_over else IDLE_AGE
            if max(entry.until, entry.touched_at) + age > now or (entry.configuration > FIRST and not entry.is_over):
                self._entries[task_id] = self._entries.pop(task_id)  # to the end of the queue
                continue
            self.floor = max(self.floor, Ballot(entry.promised.counter, ""))
            self.token = max(self.token, entry.token)
            del self._entries[task_id], self._buckets[_bucket(task_id)][task_id]
            self._keep_state()
            self._note(_bucket(task_id))
        return len(self._entries) < MAX_TASKS

    def _note(self, number: int) -> None:
        if self._store is not None:
            rows = {task_id: self._entries[task_id].packed() for task_id in self._buckets.get(number, ())}
            self._store.note(f"lease/{number}", bytes(msgpack.packb(rows)))

    def _keep_state(self) -> None:
        if self._store is not None:
            self._store.note(_STATE, bytes(msgpack.packb([self.floor.counter, self.longest, self.token])))

    def _load(self, store: Store, now: float) -> None:
        """Take up an earlier life; what was leased in it is leased for as long again from ``now`` on."""
        state = _unpacked(store.noted(_STATE))
        if isinstance(state, list) and len(state) == 2:
            state = [*state, state[0]]  # of a version that had one floor for both
        if not isinstance(state, list) or len(state) != 3:
            state = [None, None, None]
        if isinstance(state[1], float) and all(map(is_number, state[::2])):
            self.floor, self.longest, self.token = Ballot(state[0], ""), state[1], state[2]
            self.is_whole = store.origin != "replaced"
        for number in range(BUCKETS):
            noted = store.noted(f"lease/{number}")
            rows = _unpacked(noted) if noted else {}
            for task_id, row in rows.items() if isinstance(rows, dict) else ():
                entry = entry_of(row)
                if entry is None or not isinstance(task_id, str):
                    self.is_whole = False
                    continue
                entry.touched_at, entry.until = now, now + entry.ttl if entry.ballot != NONE else 0.0
                entry.ceiling = Ceiling(now, entry.promised, entry.token)
                self._enter(task_id, entry)
            self.is_whole = self.is_whole and isinstance(rows, dict)


def entry_of(row: object) -> Entry | None:
    """The entry that ``packed`` made, or None where the row cannot be one; never raises."""
    if not isinstance(row, list) or not 6 <= len(row) <= 8:
        return None
    configuration, ballots, token, ttl, packed, is_over = row[:6]
    charter = row[6] if len(row) > 6 else b""  # the version before kept none
    if not isinstance(ballots, list) or len(ballots) != 8:
        return None
    grantee = row[7] if len(row) > 7 else ballots[3]  # the versions before knew that of a lease not given back
    members = members_of(packed)
    lawful = (
        all(map(is_number, (configuration, token, *ballots[::2])))
        and all(isinstance(agent, str) for agent in (*ballots[1::2], grantee))
        and isinstance(ttl, float)
        and isinstance(is_over, bool)
        and isinstance(charter, bytes)
        and len(charter) <= MAX_BYTES
    )
    if not lawful or members is None:
        return None
    promised, ballot, spent, sealed = (Ballot(ballots[n], ballots[n + 1]) for n in range(0, 8, 2))
    return Entry(configuration, promised, ballot, token, grantee, ttl, spent, sealed, members, is_over, charter)


def _unpacked(noted: bytes | None) -> object:
    if noted is None:
        return None
    try:
        return msgpack.unpackb(noted, strict_map_key=True, max_ext_len=0)
    except Exception:  # the decoder raises many kinds on rotten bytes
        return None


def _bucket(task_id: str) -> int:
    return zlib.crc32(task_id.encode()) % BUCKETS
