"""Record: what the network keeps, and which of two records holds.

A record lives in a slot (key, owner, name).  Many owners may write under one key, each in slots of its own, so a set
under one key merges without read-modify-write.  In one slot the higher sequence wins; a record without a value is a
tombstone.  Records are signed by their owner (Ed25519); durations travel, moments do not.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import msgpack

from middleware.entangled.identity import Identity, verified

Lifetime = Literal["leased", "team"]
KEY_BYTES = 20
MAX_VALUE = 2**20
MAX_NAME = 64
MAX_SIGNED = 512
FRAME_BYTES = 160
"""What a record takes in a message beside its name and value."""
MAX_TTL = 30 * 86400.0
TEAM_TTL = 86400.0
"""How long a team record outlives the last word of its owner."""
TOLERATED_ABSENCE = 6 * 86400.0
"""A node that was away for longer re-joins empty; a robot in its box over the holidays is a new one.  What it holds
might have been deleted meanwhile, and who could tell it?"""
TOMBSTONE_TTL = TOLERATED_ABSENCE + 86400.0
"""A tombstone outlives every absence that is tolerated, by a day for clocks and late deliveries."""


class Slot(NamedTuple):
    """Where a record lives."""

    key: bytes
    owner: bytes
    name: str


@dataclass(frozen=True)
class Record:
    """One signed entry.

    ``owner`` is the public key (32 bytes); ``ttl`` is in seconds and counts from arrival: a ``leased`` record lives
    that long after the last sign of its owner, a ``team`` record that long after it was stored.  ``value`` is at most
    ``MAX_VALUE`` bytes of msgpack, or None for a tombstone.  ``slot`` is where the record lives.
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
        """Whether this record says that its slot is empty."""
        return self.value is None

    @property
    def message_bytes(self) -> int:
        """About how many bytes this record takes in a message; what it takes in a store is ``data.store.weight``."""
        return len(self.value or b"") + len(self.name.encode()) + FRAME_BYTES

    def beats(self, other: Record | None) -> bool:
        """Whether this record holds against ``other`` of the same slot; a total order, so replicas agree."""
        if other is None:
            return True
        return (self.sequence, self.signature) > (other.sequence, other.signature)

    def signed(self, identity: Identity) -> Record:
        """This record with its owner's signature."""
        return replace(self, signature=identity.sign(self._signed_bytes()))

    def is_genuine(self) -> bool:
        """Whether the owner signed exactly this."""
        return verified(self.owner, self._signed_bytes(), self.signature)

    def digest(self) -> bytes:
        """32 bytes that no other record has, in any part of it."""
        return hashlib.blake2s(self._signed_bytes() + self.signature).digest()

    def _signed_bytes(self) -> bytes:
        return bytes(msgpack.packb([b"swarm-record-1", *self.packed()[:-1]]))

    def packed(self) -> list[object]:
        """The record as it stands in a message."""
        return [self.key, self.name, self.owner, self.sequence, self.lifetime, self.ttl, self.value, self.signature]


def unpacked(fields: object) -> Record | None:
    """The record that ``packed`` made, or None where the fields cannot be one (wrong type, length or range)."""
    if not isinstance(fields, list) or len(fields) != 8:
        return None
    key, name, owner, sequence, lifetime, ttl, value, signature = fields
    lawful = (
        isinstance(key, bytes)
        and len(key) == KEY_BYTES
        and isinstance(name, str)
        and len(name) <= MAX_NAME
        and isinstance(owner, bytes)
        and len(owner) == 32
        and type(sequence) is int
        and 0 <= sequence < 2**63
        and lifetime in ("leased", "team")
        and type(ttl) is float
        and 0.0 < ttl <= MAX_TTL
        and (value is None or (isinstance(value, bytes) and len(value) <= MAX_VALUE))
        and isinstance(signature, bytes)
        and len(signature) == 64
    )
    return Record(key, name, owner, sequence, lifetime, ttl, value, signature) if lawful else None


def slot_unpacked(fields: object) -> Slot | None:
    """The slot that stands in a message as a list of key, owner and name, or None where the fields cannot be one."""
    if not isinstance(fields, list) or [type(part) for part in fields] != [bytes, bytes, str]:
        return None
    return Slot(*fields)


class Signed:
    """Remembers which records had a good signature, the last ``MAX_SIGNED`` of them; to check one takes 80 us."""

    def __init__(self) -> None:
        self._digests: OrderedDict[bytes, None] = OrderedDict()

    def __len__(self) -> int:
        return len(self._digests)

    def is_genuine(self, record: Record) -> bool:
        """Whether the owner signed exactly this, as ``record.is_genuine`` says."""
        digest = record.digest()
        if digest in self._digests:
            self._digests.move_to_end(digest)
            return True
        if not record.is_genuine():
            return False
        self._digests[digest] = None
        if len(self._digests) > MAX_SIGNED:
            self._digests.popitem(last=False)
        return True


def hashed_key(text: str) -> bytes:
    """The 160-bit key of a text (thesis, Algorithm 4.2)."""
    return hashlib.blake2s(text.encode(), digest_size=KEY_BYTES).digest()
