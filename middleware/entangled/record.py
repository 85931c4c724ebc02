"""Records: signed values under a key, and the order between two records of one slot.

A record has a slot (key, owner, name).  Many owners may write under one key, each in its own slots, so sets of records
under a key can be merged without read-modify-write.  Within a slot the record with the higher sequence number
supersedes the other; a record without a value is a tombstone.  The owner signs each record (Ed25519).  Records contain
durations, not times of day.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import msgpack

from middleware.entangled.identity import Identity, is_signature_valid

Lifetime = Literal["leased", "team"]
KEY_BYTES = 20
MAX_VALUE_BYTES = 2**20
MAX_NAME_BYTES = 64
MAX_CACHED = 512
FRAME_BYTES = 160
"""The size of a record in a message in bytes, in addition to its name and value."""
MAX_TTL_S = 30 * 86400.0
TEAM_TTL_S = 86400.0
"""Seconds after which a team record expires if it was not stored or refreshed again."""
TOLERATED_ABSENCE_S = 6 * 86400.0
"""The longest absence of a node in seconds after which it joins with its store.

After a longer absence it joins with an empty store, because tombstones of records that it still stores may have
expired.
"""
TOMBSTONE_TTL_S = TOLERATED_ABSENCE_S + 86400.0
"""Seconds until a tombstone expires: a day more than ``TOLERATED_ABSENCE_S``, for clock errors and late delivery."""


class Slot(NamedTuple):
    """The identification of one record: its key, owner and name."""

    key: bytes
    owner: bytes
    name: str


@dataclass(frozen=True)
class Record:
    """One signed value in its slot.

    ``owner`` is the public key (32 bytes).  ``ttl`` is in seconds: a ``leased`` record expires when its owner has been
    silent for this time, a ``team`` record this time after it was stored or refreshed.  ``value`` is at most
    ``MAX_VALUE_BYTES`` bytes of msgpack, or None for a tombstone.
    """

    key: bytes
    name: str
    owner: bytes
    sequence: int
    lifetime: Lifetime
    ttl: float
    value: bytes | None
    signature: bytes = b""
    slot: Slot = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "slot", Slot(self.key, self.owner, self.name))

    @property
    def is_tombstone(self) -> bool:
        """Whether this record marks its slot as deleted."""
        return self.value is None

    @property
    def message_bytes(self) -> int:
        """The approximate size of this record in a message; ``data.store.count_bytes`` is its size in a store."""
        return len(self.value or b"") + len(self.name.encode()) + FRAME_BYTES

    def supersedes(self, other: Record | None) -> bool:
        """Return whether this record replaces ``other`` in their slot; the order is total, so replicas converge."""
        if other is None:
            return True
        return (self.sequence, self.signature) > (other.sequence, other.signature)

    def sign(self, identity: Identity) -> Record:
        """Return a copy of this record signed by its owner's ``identity``."""
        return replace(self, signature=identity.sign(self._signed_bytes()))

    def is_genuine(self) -> bool:
        """Return whether the owner's signature over all fields is valid."""
        return is_signature_valid(self.owner, self._signed_bytes(), self.signature)

    def digest(self) -> bytes:
        """Return the 32-byte hash of all fields and the signature."""
        return hashlib.blake2s(self._signed_bytes() + self.signature).digest()

    def _signed_bytes(self) -> bytes:
        return bytes(msgpack.packb([b"swarm-record-1", *self.pack()[:-1]]))

    def pack(self) -> list[object]:
        """Return the fields for a message."""
        return [self.key, self.name, self.owner, self.sequence, self.lifetime, self.ttl, self.value, self.signature]


def parse_record(fields: object) -> Record | None:
    """Parse the fields of ``Record.pack``; None if a type, length or range is wrong."""
    if not isinstance(fields, list) or len(fields) != 8:
        return None
    key, name, owner, sequence, lifetime, ttl, value, signature = fields
    is_valid = (
        isinstance(key, bytes)
        and len(key) == KEY_BYTES
        and isinstance(name, str)
        and len(name) <= MAX_NAME_BYTES
        and isinstance(owner, bytes)
        and len(owner) == 32
        and type(sequence) is int
        and 0 <= sequence < 2**63
        and lifetime in ("leased", "team")
        and type(ttl) is float
        and 0.0 < ttl <= MAX_TTL_S
        and (value is None or (isinstance(value, bytes) and len(value) <= MAX_VALUE_BYTES))
        and isinstance(signature, bytes)
        and len(signature) == 64
    )
    return Record(key, name, owner, sequence, lifetime, ttl, value, signature) if is_valid else None


def parse_slot(fields: object) -> Slot | None:
    """Parse a slot, [key, owner, name]; None if a type is wrong."""
    if not isinstance(fields, list) or [type(part) for part in fields] != [bytes, bytes, str]:
        return None
    return Slot(*fields)


class SignatureCache:
    """A cache of the last ``MAX_CACHED`` records with a valid signature; each verification takes 80 us."""

    def __init__(self) -> None:
        self._digests: OrderedDict[bytes, None] = OrderedDict()

    def __len__(self) -> int:
        return len(self._digests)

    def is_genuine(self, record: Record) -> bool:
        """Return ``record.is_genuine()``, from the cache if possible."""
        digest = record.digest()
        if digest in self._digests:
            self._digests.move_to_end(digest)
            return True
        if not record.is_genuine():
            return False
        self._digests[digest] = None
        if len(self._digests) > MAX_CACHED:
            self._digests.popitem(last=False)
        return True


def hash_key(text: str) -> bytes:
    """Return the 160-bit key of ``text`` (thesis, Algorithm 4.2)."""
    return hashlib.blake2s(text.encode(), digest_size=KEY_BYTES).digest()
