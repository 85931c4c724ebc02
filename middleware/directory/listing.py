"""Listing: a walk through the places of the directory, which knows whom it may not have seen; pure.

Whoever lists reads a place, and goes on to the half that has another key as deep as any device there says that it
stands, or as deep as the reader itself expects; the other half has the same key.  So each place is read once, and what
is read is in proportion to what is there.
"""

from __future__ import annotations

from collections.abc import Iterable

from middleware.directory.prefix import ROOT, Prefix, places_of
from middleware.directory.presence import Device, device_of
from middleware.entangled.identity import node_id
from middleware.entangled.record import Record

MOST_READS = 20_000
"""Places that one listing reads; further ones are left out, and it is not complete."""


class Listing:
    """The devices below ``under``; the walk goes down to the depth ``floor`` at least.

    ``reads`` counts the places that were read; ``missed`` are those whose holders gave no answer.
    """

    def __init__(self, floor: int = 0, under: Prefix = ROOT) -> None:
        self._floor = floor
        self._waiting = [under]
        self._found: dict[bytes, tuple[Device, Record]] = {}
        self._open = 0
        self.reads = 0
        self.missed: list[Prefix] = []

    def next(self) -> Prefix | None:
        """A place that is to be read now, or None where nothing is known to be left (ask again after an answer)."""
        if not self._waiting:
            return None
        if self.reads >= MOST_READS:
            self.missed += self._waiting
            self._waiting.clear()
            return None
        self.reads += 1
        self._open += 1
        return self._waiting.pop()

    def read(self, place: Prefix, records: Iterable[Record]) -> None:
        """``records`` are what is held under the key of ``place``."""
        self._open -= 1
        below = []
        for device, record in standing(place.key, records):
            known = self._found.get(record.owner)
            if known is None or record.sequence > known[1].sequence:
                self._found[record.owner] = (device, record)
            below.append((node_id(record.owner), device.depth))
        while True:
            depths = [depth for uuid, depth in below if place.has(uuid)]
            if place.depth >= max([self._floor, *depths]):
                return
            self._waiting.append(place.aside)
            place = place.along

    def failed(self, place: Prefix) -> None:
        """Nobody could say what is at ``place``."""
        self._open -= 1
        self.missed.append(place)

    @property
    def is_over(self) -> bool:
        """Whether nothing is left to be read."""
        return not (self._waiting or self._open)

    @property
    def is_complete(self) -> bool:
        """Whether every place was read, so that nobody who stands where its neighbours do was missed."""
        return self.is_over and not self.missed

    @property
    def devices(self) -> list[tuple[Device, Record]]:
        """The devices that were found, each with its record, in the order of their keys."""
        return [self._found[owner] for owner in sorted(self._found)]

    @property
    def records(self) -> list[Record]:
        """The record of each device that was found."""
        return [record for _, record in self.devices]


def standing(key: bytes, records: Iterable[Record]) -> list[tuple[Device, Record]]:
    """The devices among ``records`` that stand under ``key``; who writes anywhere else is not listed there."""
    known = [(device, record) for record in records if (device := device_of(record)) is not None]
    return [(device, record) for device, record in known if key in places_of(node_id(record.owner), device.depth)]
