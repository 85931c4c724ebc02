"""The keys under which devices are listed in the directory, and the depth to which the directory is split; pure.

The directory is a trie over node ids.  A *place* is one of its parts: at depth d, it lists the devices whose ids start
with the same d bits.  The key of a place is the key of the directory with its first d bits replaced by these bits.  At
depth 0 there is a single place for all devices.  A split leaves one half of a place under the same key, so each key at
a depth is also a key at the next depth.  The k nodes closest to the key of a place are neighbours of the devices that
it lists, so these devices need no lookup to find them.

A device is listed at two depths: its own depth and one less.  So a node that reads at either of these depths finds the
device, and when the depth of the device changes by one, one of its two places remains the same.
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
MIN_DEVICES_PER_PLACE = 12
"""Minimum estimated number of devices per place."""
MAX_UNDIVIDED = 64
"""Maximum size of a team whose directory is not split; in larger teams no node knows all others."""
UNDIVIDED_AGAIN = 48
"""If a team shrinks to this size or below, its directory is no longer split."""
ROOT_LISTED_DEPTH = 2
DEPTH_HYSTERESIS = 0.25
"""The depth of a device changes only if the team's size has passed a limit by this factor (as a power of two)."""
NEAREST_CONTACTS = 8
"""Number of nearest contacts from which the size of a team is estimated, because a node knows all of these."""
MAX_LEASE_S = 60.0
"""Maximum seconds for which a failed device remains listed."""


class Prefix(NamedTuple):
    """A place: the ids whose first ``depth`` bits are ``bits``."""

    depth: int
    bits: int

    @property
    def key(self) -> bytes:
        """The key of this place."""
        free = BITS - self.depth
        return (self.bits << free | _ROOT_NUMBER & ((1 << free) - 1)).to_bytes(ID_BYTES)

    @property
    def same_key_half(self) -> Prefix:
        """The half of this place that has the same key."""
        return Prefix(self.depth + 1, self.bits << 1 | self._next_bit)

    @property
    def other_key_half(self) -> Prefix:
        """The half of this place that has a different key."""
        return Prefix(self.depth + 1, self.bits << 1 | 1 - self._next_bit)

    @property
    def first(self) -> bytes:
        """The lowest id with this prefix."""
        return (self.bits << (BITS - self.depth)).to_bytes(ID_BYTES)

    def has(self, node_id: bytes) -> bool:
        """Return whether ``node_id`` has this prefix."""
        return int.from_bytes(node_id) >> (BITS - self.depth) == self.bits

    @property
    def _next_bit(self) -> int:
        return _ROOT_NUMBER >> (BITS - self.depth - 1) & 1


_ROOT_NUMBER = int.from_bytes(DEVICES)
ROOT = Prefix(0, 0)


def compute_prefix(node_id: bytes, depth: int) -> Prefix:
    """Return the prefix of ``node_id`` with ``depth`` bits."""
    return Prefix(depth, int.from_bytes(node_id) >> (BITS - depth))


def compute_places(node_id: bytes, depth: int) -> list[bytes]:
    """Return the one to three keys under which a device with that id and depth is listed.

    Up to ``ROOT_LISTED_DEPTH``, the key of depth 0 is included: when a team shrinks, some nodes already read only this
    key while others are still at a greater depth.
    """
    depths = (depth, max(0, depth - 1), *((0,) if depth <= ROOT_LISTED_DEPTH else ()))
    return list(dict.fromkeys(compute_prefix(node_id, each).key for each in depths))


def is_place(key: bytes, node_id: bytes) -> bool:
    """Return whether a device with that id can be listed under ``key`` at any depth."""
    if key[MAX_DEPTH // 8 :] != DEVICES[MAX_DEPTH // 8 :]:
        return False
    return any(key == compute_prefix(node_id, depth).key for depth in range(MAX_DEPTH + 1))


def choose_depth(size: float, depth: int | None = None) -> int:
    """Return the depth for a team of ``size``, at most one step from ``depth`` (None: no depth yet)."""
    if depth is None:
        return (
            0 if size <= MAX_UNDIVIDED else min(MAX_DEPTH, max(0, math.floor(math.log2(size / MIN_DEVICES_PER_PLACE))))
        )
    if size <= (UNDIVIDED_AGAIN if depth else MAX_UNDIVIDED):
        return max(0, depth - 1)
    level = math.log2(size / MIN_DEVICES_PER_PLACE)
    if level >= depth + 1 + DEPTH_HYSTERESIS and depth < MAX_DEPTH:
        return depth + 1
    return depth - 1 if depth and level < depth - DEPTH_HYSTERESIS else depth


def compute_lease(depth: int, lease: float) -> float:
    """Return the seconds for which a device at ``depth`` remains listed after its last renewal.

    ``lease`` is the presence lease of the device's node.  If the number of devices doubles, each device renews half as
    often, but at least every minute.
    """
    return lease if not depth else max(lease, min(MAX_LEASE_S, lease * 2.0**depth))


def estimate_size(own_id: bytes, contacts: Iterable[Contact]) -> int:
    """Estimate the number of nodes, including this one, from the density of ids around it.

    Ids are uniformly distributed, so the n-th nearest of N nodes is about n / N of the key space away.
    """
    distances = sorted(distance(own_id, contact.node_id) for contact in contacts)
    if len(distances) < NEAREST_CONTACTS:
        return len(distances) + 1
    return max(len(distances) + 1, NEAREST_CONTACTS * (1 << BITS) // max(1, distances[NEAREST_CONTACTS - 1]))
