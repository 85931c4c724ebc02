"""A walk through the parts of the directory, which also records the parts that could not be read; pure.

The devices of a part can be listed at a greater depth, in its two halves.  One half has the same key as the part, so it
need not be read again.  The walk reads the other half, which has a different key, and continues down to the depth of
the deepest device in the part, or the reader's own depth.  So each key is read once, and the number of reads is
proportional to the number of devices.
"""

from __future__ import annotations

from collections.abc import Iterable

from middleware.directory.prefix import ROOT, Prefix, compute_places
from middleware.directory.presence import Device, parse_device
from middleware.entangled.identity import derive_node_id
from middleware.entangled.record import Record

MAX_READS = 20_000
"""Maximum number of parts that one listing reads; if there are more, the listing is incomplete."""


class Listing:
    """The devices whose ids have the prefix ``under``; the walk reaches at least the depth ``floor``.

    ``reads`` is the number of parts that were read; ``missed`` are the parts that could not be read.
    """

    def __init__(self, floor: int = 0, under: Prefix = ROOT) -> None:
        self._floor = floor
        self._unread = [under]
        self._found: dict[bytes, tuple[Device, Record]] = {}
        self._pending_reads = 0
        self.reads = 0
        self.missed: list[Prefix] = []

    def take_next(self) -> Prefix | None:
        """Return a part to read now, or None if no part can be read before the next call of ``add_records``."""
        if not self._unread:
            return None
        if self.reads >= MAX_READS:
            self.missed += self._unread
            self._unread.clear()
            return None
        self.reads += 1
        self._pending_reads += 1
        return self._unread.pop()

    def add_records(self, place: Prefix, records: Iterable[Record]) -> None:
        """Process the ``records`` under the key of the part ``place``."""
        self._pending_reads -= 1
        below = []
        for device, record in select_listed(place.key, records):
            known = self._found.get(record.owner)
            if known is None or record.sequence > known[1].sequence:
                self._found[record.owner] = (device, record)
            below.append((derive_node_id(record.owner), device.depth))
        while True:
            depths = [depth for uuid, depth in below if place.has(uuid)]
            if place.depth >= max([self._floor, *depths]):
                return
            self._unread.append(place.other_key_half)
            place = place.same_key_half

    def on_failure(self, place: Prefix) -> None:
        """Record that no replica of the part ``place`` answered."""
        self._pending_reads -= 1
        self.missed.append(place)

    @property
    def is_over(self) -> bool:
        """Whether no part remains to be read."""
        return not (self._unread or self._pending_reads)

    @property
    def is_complete(self) -> bool:
        """Whether every part was read, so that no device listed at the depth of its neighbours is missing."""
        return self.is_over and not self.missed

    @property
    def devices(self) -> list[tuple[Device, Record]]:
        """The devices that were found, each with its record, sorted by public key."""
        return [self._found[owner] for owner in sorted(self._found)]

    @property
    def records(self) -> list[Record]:
        """The records of the devices that were found."""
        return [record for _, record in self.devices]


def select_listed(key: bytes, records: Iterable[Record]) -> list[tuple[Device, Record]]:
    """Return the devices in ``records`` that are listed under ``key``; other records are ignored."""
    known = [(device, record) for record in records if (device := parse_device(record)) is not None]
    return [
        (device, record)
        for device, record in known
        if key in compute_places(derive_node_id(record.owner), device.depth)
    ]
