"""A walk through the places of the directory that knows which devices it may have missed; pure.

After reading a place, the walk continues to the half with another key, down to the depth of the deepest device found
there or the reader's own; the other half has the same key.  So each place is read once, and the number of reads is
proportional to the number of devices.
"""

from __future__ import annotations

from collections.abc import Iterable

from middleware.directory.prefix import ROOT, Prefix, compute_places
from middleware.directory.presence import Device, parse_device
from middleware.entangled.identity import derive_node_id
from middleware.entangled.record import Record

MAX_READS = 20_000
"""Maximum number of places that one listing reads; beyond it the listing is incomplete."""


class Listing:
    """The devices below ``under``; the walk reaches at least the depth ``floor``.

    ``reads`` is the number of places read; ``missed`` are the places that could not be read.
    """

    def __init__(self, floor: int = 0, under: Prefix = ROOT) -> None:
        self._floor = floor
        self._unread = [under]
        self._found: dict[bytes, tuple[Device, Record]] = {}
        self._pending_reads = 0
        self.reads = 0
        self.missed: list[Prefix] = []

    def take_next(self) -> Prefix | None:
        """Return a place to read now, or None if none is known (call again after the next ``add_records``)."""
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
        """Process the ``records`` under the key of ``place``."""
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
        """Record that no replica of ``place`` answered."""
        self._pending_reads -= 1
        self.missed.append(place)

    @property
    def is_over(self) -> bool:
        """Whether all places have been read."""
        return not (self._unread or self._pending_reads)

    @property
    def is_complete(self) -> bool:
        """Whether every place was read, so that no device at the depth of its neighbours was missed."""
        return self.is_over and not self.missed

    @property
    def devices(self) -> list[tuple[Device, Record]]:
        """The devices found with their records, sorted by key."""
        return [self._found[owner] for owner in sorted(self._found)]

    @property
    def records(self) -> list[Record]:
        """The records of the devices found."""
        return [record for _, record in self.devices]


def select_listed(key: bytes, records: Iterable[Record]) -> list[tuple[Device, Record]]:
    """Return the devices in ``records`` whose places include ``key``; other records are ignored."""
    known = [(device, record) for record in records if (device := parse_device(record)) is not None]
    return [
        (device, record)
        for device, record in known
        if key in compute_places(derive_node_id(record.owner), device.depth)
    ]
