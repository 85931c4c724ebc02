"""The durable log of an acceptor, which preserves tokens and promises over a restart.

Registers are grouped into buckets; each bucket is stored as one note.  When registers are evicted, their highest
ballots and tokens are recorded in a ``Floor``, below which nothing is granted.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

from middleware.entangled.quorum.ballot import NO_BALLOT, Ballot, Ceiling, ProposerName
from middleware.entangled.quorum.register import Register

MAX_REGISTERS = 4096
MAX_SEARCHED = 256
"""The number of the oldest registers that are examined for eviction; to examine all registers would take too long."""

Key = TypeVar("Key", bound=Hashable)


class Floor(NamedTuple):
    """Upper bounds of the counters and tokens of evicted registers, and the longest ttl ever granted."""

    counter: int = 0
    token: int = 0
    longest: float = 0.0


class NoteStore(Protocol):
    """A durable map of small values; ``Store`` implements it."""

    def set_note(self, name: str, value: bytes) -> None:
        """Store ``value`` under ``name``."""

    def get_note(self, name: str) -> bytes | None:
        """Return the value under ``name``, or None."""


@dataclass(frozen=True)
class Codec(Generic[Key]):
    """The encoding of the registers of one use as notes; decoders return None instead of raising.

    ``name`` is the format string of the names of the ``buckets``.  ``lowest_name`` is a name below all names of
    proposers.  The counters of a proposer's ballots differ modulo ``lives`` after a restart of its process; ``lives``
    is 1 if each process has a new name.  ``unpack`` also returns whether the note was complete.
    """

    floor_name: str
    name: str
    buckets: int
    lowest_name: ProposerName
    lives: int
    bucket_of: Callable[[Key], str]
    pack: Callable[[dict[Key, Register]], bytes]
    unpack: Callable[[bytes], tuple[dict[Key, Register], bool]]
    pack_floor: Callable[[Floor], bytes]
    unpack_floor: Callable[[bytes | None], Floor | None]

    @property
    def names(self) -> Iterator[str]:
        """The names of all buckets."""
        return map(self.name.format, range(self.buckets))


class RegisterLog(Generic[Key]):
    """The registers of one acceptor, in memory and in ``notes``.

    ``is_whole`` is False if notes of an earlier process are missing or corrupt.  ``may_forget`` returns whether a
    register may be evicted.
    """

    def __init__(
        self, notes: NoteStore, codec: Codec[Key], may_forget: Callable[[Key, Register, float], bool], now: float = 0.0
    ) -> None:
        self.registers: dict[Key, Register] = {}
        self._notes = notes
        self.codec = codec
        self._may_forget = may_forget
        self._buckets: dict[str, dict[Key, None]] = {}
        floor = codec.unpack_floor(notes.get_note(codec.floor_name))
        self.is_complete = floor is not None
        self.floor = floor or Floor()
        for name in codec.names:
            noted = notes.get_note(name)
            rows, is_whole = codec.unpack(noted) if noted else ({}, True)
            self.is_complete = self.is_complete and is_whole
            for key, register in rows.items():
                register.restart_leases(now, codec.lives)
                self._add(key, register)
        if floor is None:
            self._note_floor()

    def __len__(self) -> int:
        return len(self.registers)

    def get(self, key: Key) -> Register | None:
        """Return the register under ``key``, or None."""
        return self.registers.get(key)

    def make_register(self, now: float) -> Register:
        """Return a new register that is not in the log yet."""
        counter, token, _ = self.floor
        # R3: this ballot is higher than every ballot that an evicted register may have promised.
        promised = Ballot(counter + 1, self.codec.lowest_name) if counter else NO_BALLOT
        ceiling = Ceiling(now, self.codec.lives, counter, token)
        return Register(ceiling, promised=promised, token=token, touched_at=now)

    def add(self, key: Key, register: Register, now: float) -> bool:
        """Add a register; return False if there is no space."""
        if len(self.registers) >= MAX_REGISTERS and not self._make_room(now):
            return False
        self._add(key, register)
        return True

    def write(self, key: Key) -> None:
        """Write the current state of a register to the notes."""
        longest = self.registers[key].ttl
        if longest > self.floor.longest:
            self.floor = self.floor._replace(longest=longest)
            self._note_floor()
        self._note(self.codec.bucket_of(key))

    def clear(self) -> None:
        """Remove all registers and the floor, once no proposer relies on this acceptor's votes."""
        self.registers.clear()
        self._buckets.clear()
        self.floor, self.is_complete = Floor(), True
        for name in self.codec.names:
            if self._notes.get_note(name):
                self._note(name)
        self._note_floor()

    def _add(self, key: Key, register: Register) -> None:
        self.registers[key] = register
        self._buckets.setdefault(self.codec.bucket_of(key), {})[key] = None

    def _make_room(self, now: float) -> bool:
        """Evict old registers that are no longer needed; return whether there is space for another."""
        buckets = set()
        for key in list(self.registers)[:MAX_SEARCHED]:
            register = self.registers.pop(key)
            if not self._may_forget(key, register, now):
                self.registers[key] = register  # to the end of the queue
                continue
            counter, token, longest = self.floor
            # R3: all evicted numbers are at most the floor.
            self.floor = Floor(max(counter, register.promised.counter), max(token, register.token), longest)
            name = self.codec.bucket_of(key)
            del self._buckets[name][key]
            buckets.add(name)
        if buckets:
            self._note_floor()  # before the registers are removed from their buckets
        for name in sorted(buckets):
            self._note(name)
        return len(self.registers) < MAX_REGISTERS

    def _note(self, name: str) -> None:
        rows = {key: self.registers[key] for key in self._buckets.get(name, ())}
        self._notes.set_note(name, self.codec.pack(rows))

    def _note_floor(self) -> None:
        self._notes.set_note(self.codec.floor_name, self.codec.pack_floor(self.floor))
