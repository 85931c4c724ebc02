"""A subscription to the list of all devices, for teams of any size.

As long as the directory has a single key, this key is watched.  In a larger team the keys are read one after another,
at a constant rate, because watching a thousand keys would need a thousand times as many renewals.
"""

from __future__ import annotations

from collections.abc import Iterable

from middleware.directory.directory import CONCURRENT_READS, Directory
from middleware.directory.listing import Listing
from middleware.directory.presence import DEVICES
from middleware.entangled.identity import derive_node_id
from middleware.entangled.record import Record
from middleware.entangled.replication.watch import OnChanged, Watch

READS_PER_S = 16
"""Maximum number of keys that are read per second: 10,000 devices are read about once a minute."""
ROUND_PAUSE_S = 2.0
"""Minimum seconds between two rounds."""
DEPTH_MARK = b"\xa5depth"
"""A byte sequence that the record of each device contains, unless the device is at depth 0."""


class DeviceSubscription:
    """Calls ``changed`` with the records of all devices after each change; ``records`` are the current records.

    If ``keep`` is true and the directory has a single key, the records are also kept in the node's store.  In a large
    team one replica of each key is read.  A single replica may lack some records, so a device is removed only if it was
    missing in two successive rounds.
    """

    def __init__(self, directory: Directory, changed: OnChanged, keep: bool = False) -> None:
        self.records: list[Record] = []
        self._directory = directory
        self._changed = changed
        self._is_stopped = False
        self._is_split = False
        self._unseen: set[bytes] = set()
        self._watch: Watch | None = None
        self._watch = directory.entangled.watch(DEVICES, self._on_records, keep)

    def stop(self) -> None:
        """End the subscription."""
        self._is_stopped = True
        if self._watch is not None:
            self._watch.stop()

    # -- inside -----------------------------------------------------------------------------------------------------

    def _on_records(self, records: list[Record]) -> None:
        if self._directory.depth > 1 or any(DEPTH_MARK in (record.value or b"") for record in records):
            if not self._is_split:
                self._is_split = True
                self._directory.background.fork(self._read_repeatedly())
        elif not self._is_split:
            self._notify(records)

    async def _read_repeatedly(self) -> None:
        """Read all keys repeatedly, until the team is small again."""
        while not self._is_stopped:
            listing = await self._directory.list_devices(
                "fast", on_found=self._report_new, pause=CONCURRENT_READS / READS_PER_S
            )
            self._remove_missing(listing)
            if listing.is_complete and listing.reads == 1 and self._directory.depth < 2:
                break
            await self._directory.background.sleep(ROUND_PAUSE_S)
        self._is_split = False
        if self._watch is not None and not self._is_stopped:
            self._on_records(self._watch.records)

    def _report_new(self, listing: Listing) -> None:
        """Report new devices immediately."""
        newest = {record.owner: record for record in self.records}
        for record in listing.records:
            known = newest.get(record.owner)
            if known is None or record.sequence > known.sequence:
                newest[record.owner] = record
        self._notify(newest.values())

    def _remove_missing(self, listing: Listing) -> None:
        """Remove devices that were missing in this round and the previous round, although their keys were read."""
        seen = {record.owner for record in listing.records}
        unseen = {
            record.owner
            for record in self.records
            if record.owner not in seen and not any(place.has(derive_node_id(record.owner)) for place in listing.missed)
        }
        removed, self._unseen = unseen & self._unseen, unseen
        self._notify(record for record in self.records if record.owner not in removed)

    def _notify(self, records: Iterable[Record]) -> None:
        ordered = sorted(records, key=lambda record: (record.owner, record.name))
        if ordered != self.records and not self._is_stopped:
            self.records = ordered
            self._changed(list(ordered))
