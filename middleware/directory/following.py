"""Following: one subscriber to the list of all devices, in a team of any size.

A team with one place is watched there.  In a larger one the places are read in turn, some of them each second, however
many there are: to watch a thousand keys would be a thousand times the renewals.
"""

from __future__ import annotations

from collections.abc import Iterable

from middleware.directory.directory import AT_ONCE, Directory
from middleware.directory.listing import Listing
from middleware.directory.presence import DEVICES
from middleware.entangled.identity import node_id
from middleware.entangled.record import Record
from middleware.entangled.replication.watch import Changed, Watch

READS_PER_S = 16
"""Places that a follower reads in a second, at most: 10,000 devices are seen anew about once a minute."""
REST = 2.0
"""Seconds between two rounds, at least."""
MARK = b"\xa5depth"
"""Stands in the value of each device that says it is not at depth 0."""


class Following:
    """Tells ``changed`` of all devices' records whenever they differ; ``records`` is what is known now.

    With ``keep`` the records of a team with one place are in the node's own store as well.  In a large team one holder
    of each place is asked, which may lack some: a device is let go of when two rounds in a row did not show it.
    """

    def __init__(self, directory: Directory, changed: Changed, keep: bool = False) -> None:
        self.records: list[Record] = []
        self._directory = directory
        self._changed = changed
        self._is_stopped = False
        self._is_split = False
        self._unseen: set[bytes] = set()
        self._watch: Watch | None = None
        self._watch = directory.entangled.watch(DEVICES, self._told, keep)

    def stop(self) -> None:
        """End the subscription; nothing is told any more."""
        self._is_stopped = True
        if self._watch is not None:
            self._watch.stop()

    # -- inside -----------------------------------------------------------------------------------------------------

    def _told(self, records: list[Record]) -> None:
        if self._directory.depth > 1 or any(MARK in (record.value or b"") for record in records):
            if not self._is_split:
                self._is_split = True
                self._directory.chores.fork(self._rounds())
        elif not self._is_split:
            self._tell(records)

    async def _rounds(self) -> None:
        """Read all places again and again, until the team is small again."""
        while not self._is_stopped:
            listing = await self._directory.listed("fast", heard=self._add, pause=AT_ONCE / READS_PER_S)
            self._replace(listing)
            if listing.is_complete and listing.reads == 1 and self._directory.depth < 2:
                break
            await self._directory.chores.sleep(REST)
        self._is_split = False
        if self._watch is not None and not self._is_stopped:
            self._told(self._watch.records)

    def _add(self, listing: Listing) -> None:
        """Tell of those that are new, as soon as they are known."""
        newest = {record.owner: record for record in self.records}
        for record in listing.records:
            known = newest.get(record.owner)
            if known is None or record.sequence > known.sequence:
                newest[record.owner] = record
        self._tell(newest.values())

    def _replace(self, listing: Listing) -> None:
        """Let go of who was not seen in this round nor in the last, where its place was read."""
        seen = {record.owner for record in listing.records}
        unseen = {
            record.owner
            for record in self.records
            if record.owner not in seen and not any(place.has(node_id(record.owner)) for place in listing.missed)
        }
        gone, self._unseen = unseen & self._unseen, unseen
        self._tell(record for record in self.records if record.owner not in gone)

    def _tell(self, records: Iterable[Record]) -> None:
        told = sorted(records, key=lambda record: (record.owner, record.name))
        if told != self.records and not self._is_stopped:
            self.records = told
            self._changed(list(told))
