"""Prefix: where in the directory a device stands, and how far the directory is split there; pure.

The directory is a trie over node ids.  The place at depth d of a device is the key of the whole directory with its
first d bits taken from the device's id, so depth 0 is one key for all, and each key of a depth is one of the next depth
too.  The k nodes closest to a place are neighbours of those that it lists: they are known without a search.

A device stands at two depths, its own and the one above it.  So it is seen by whoever looks as deep as its neighbours
stand or one less, and as it moves by one depth at a time it stays at one of the two all the while.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

from middleware.directory.presence import DEVICES, MAX_DEPTH
from middleware.entangled.contact import Contact
from middleware.entangled.identity import ID_BYTES
from middleware.entangled.kademlia.distance import distance

BITS = 8 * ID_BYTES
FEW = 12
"""Devices at a place, at least, as far as can be told: about two of them hold it for each that it lists."""
WHOLE = 64
"""Members up to which a team that is known whole has one place; beyond it nobody knows all."""
STILL_WHOLE = 48
"""Members below which a team that was larger has one place again."""
SHALLOW = 2
MARGIN = 0.25
"""How far the size must be beyond a border, in powers of two, before a device moves."""
NEAR = 8
"""Contacts by whose distance the size of a team is measured: a node knows its k nearest for certain."""
LONGEST = 60.0
"""Seconds that a device which vanished is listed at most."""


class Prefix(NamedTuple):
    """The ids that begin with the ``depth`` bits of ``bits``."""

    depth: int
    bits: int

    @property
    def key(self) -> bytes:
        """The key of this place."""
        free = BITS - self.depth
        return (self.bits << free | _ROOT & ((1 << free) - 1)).to_bytes(ID_BYTES)

    @property
    def along(self) -> Prefix:
        """The half that has the same key."""
        return Prefix(self.depth + 1, self.bits << 1 | self._next)

    @property
    def aside(self) -> Prefix:
        """The half that has another key."""
        return Prefix(self.depth + 1, self.bits << 1 | 1 - self._next)

    @property
    def first(self) -> bytes:
        """The lowest id that begins so."""
        return (self.bits << (BITS - self.depth)).to_bytes(ID_BYTES)

    def has(self, node_id: bytes) -> bool:
        """Whether ``node_id`` begins so."""
        return int.from_bytes(node_id) >> (BITS - self.depth) == self.bits

    @property
    def _next(self) -> int:
        return _ROOT >> (BITS - self.depth - 1) & 1


_ROOT = int.from_bytes(DEVICES)
ROOT = Prefix(0, 0)


def prefix_of(node_id: bytes, depth: int) -> Prefix:
    """The first ``depth`` bits of ``node_id``."""
    return Prefix(depth, int.from_bytes(node_id) >> (BITS - depth))


def places_of(node_id: bytes, depth: int) -> list[bytes]:
    """The keys, one to three, under which a device of that id stands that is at that depth.

    Up to ``SHALLOW`` the old key is one of them: as a team becomes one that is known whole, some know it sooner.
    """
    depths = (depth, max(0, depth - 1), *((0,) if depth <= SHALLOW else ()))
    return list(dict.fromkeys(prefix_of(node_id, each).key for each in depths))


def is_place(key: bytes, node_id: bytes) -> bool:
    """Whether ``key`` is a place of the directory at which a device of that id may stand, at whatever depth."""
    if key[MAX_DEPTH // 8 :] != DEVICES[MAX_DEPTH // 8 :]:
        return False
    return any(key == prefix_of(node_id, depth).key for depth in range(MAX_DEPTH + 1))


def depth_for(size: float, depth: int | None = None) -> int:
    """The depth for a team of ``size``, coming from ``depth`` (one step at most); None: it has none yet."""
    if depth is None:
        return 0 if size <= WHOLE else min(MAX_DEPTH, max(0, math.floor(math.log2(size / FEW))))
    if size <= (STILL_WHOLE if depth else WHOLE):
        return max(0, depth - 1)
    level = math.log2(size / FEW)
    if level >= depth + 1 + MARGIN and depth < MAX_DEPTH:
        return depth + 1
    return depth - 1 if depth and level < depth - MARGIN else depth


def lease_at(depth: int, lease: float) -> float:
    """Seconds that a device at ``depth`` is listed after its last sign of life, where ``lease`` is that of its node.

    Twice as many devices give a sign half as often, up to a minute.
    """
    return lease if not depth else max(lease, min(LONGEST, lease * 2.0**depth))


def size_of(own_id: bytes, contacts: Iterable[Contact]) -> int:
    """About how many nodes there are, this one included, by how dense they lie around it.

    Ids are spread evenly, so of N nodes the n-th nearest is about n / N of the whole range away.
    """
    apart = sorted(distance(own_id, contact.node_id) for contact in contacts)
    if len(apart) < NEAR:
        return len(apart) + 1
    return max(len(apart) + 1, NEAR * (1 << BITS) // max(1, apart[NEAR - 1]))
