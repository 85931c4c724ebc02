"""The directory: the list of all devices, split by prefix in a large team.

It writes the own device's record, moves it as the team grows and shrinks, and reads other devices' records.  ``prefix``
computes the places of a device, and ``listing`` the places to read.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from twisted.internet.defer import Deferred, DeferredList

from middleware.directory.listing import Listing, select_listed
from middleware.directory.prefix import (
    ROOT,
    Prefix,
    choose_depth,
    compute_lease,
    compute_places,
    compute_prefix,
    estimate_size,
)
from middleware.directory.presence import Device
from middleware.entangled.background import Background, run_limited
from middleware.entangled.errors import EntangledError
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record
from middleware.entangled.replication.reader import ReadConsistency

CONCURRENT_READS = 8
"""Number of places that one listing reads concurrently."""
PLACEMENT_STEPS, PLACEMENT_STEP_S = 50, 0.1
"""Number of steps for which a new node waits until it knows its neighbours, and their duration in seconds."""
PARTIAL_SEARCH_LEVELS = 2
"""Number of depths above its own at which a device starts a partial search: about four places."""

Matches = Callable[[Device], bool]


class Page(NamedTuple):
    """Some of the devices.

    ``next_id`` is the id from which to continue (None: the end).  ``is_complete`` is False if devices in
    this range may be missing.
    """

    records: list[Record]
    next_id: bytes | None
    is_complete: bool


class Directory:
    """The directory from the view of the node ``entangled``."""

    def __init__(self, entangled: EntangledNode, background: Background) -> None:
        self.depth = 0
        self.entangled = entangled
        self.background = background
        self._own_id = entangled.identity.node_id
        self._current_places: set[tuple[bytes, str]] = set()
        self._old_places: set[tuple[bytes, str]] = set()

    @property
    def size(self) -> int:
        """The estimated number of devices; in a small team the number of known ones."""
        overlay = self.entangled.overlay
        contacts = overlay.contacts()
        is_large = overlay.members.is_full or (overlay.is_large and not overlay.is_complete)
        return estimate_size(self._own_id, contacts) if is_large else len(contacts) + 1

    @property
    def lease(self) -> float:
        """Seconds for which this device remains listed after its last renewal."""
        return compute_lease(self.depth, self.entangled.lease)

    # -- the own record -----------------------------------------------------------------------------------------------

    async def choose_initial_depth(self) -> int:
        """Return the initial depth; in a large team, wait first until this node knows its neighbours."""
        overlay = self.entangled.overlay
        for _ in range(PLACEMENT_STEPS):
            if overlay.has_found_neighbours or not overlay.is_large:
                break
            await self.background.sleep(PLACEMENT_STEP_S)
        self.depth = choose_depth(self.size)
        return self.depth

    def update_depth(self) -> int:
        """Return the depth from now on: one more or less if the team's size has changed."""
        self.depth = choose_depth(self.size, self.depth)
        return self.depth

    def announce(self, name: str, value: bytes, depth: int) -> Deferred[Any]:
        """Write the device's packed record at its places at ``depth``, then release its previous places."""
        lease = compute_lease(depth, self.entangled.lease)
        new_places = {(key, name) for key in compute_places(self._own_id, depth)}
        self._old_places = (self._old_places | self._current_places) - new_places
        self._current_places = new_places
        puts = [
            self.entangled.put(key, name, value, "leased", lease=lease) for key in compute_places(self._own_id, depth)
        ]
        return puts[0] if len(puts) == 1 and not self._old_places else self._release_old(puts)

    def _release_old(self, puts: list[Deferred[Any]]) -> Deferred[Any]:
        def record_left(results: Any) -> None:
            for key, name in self._old_places:
                self.entangled.release(key, name)
            self._old_places.clear()

        def failed(failure: Any) -> Any:
            return failure.value.subFailure  # the previous places are kept until the next announcement

        return DeferredList(puts, fireOnOneErrback=True, consumeErrors=True).addCallbacks(record_left, failed)

    # -- other devices
    # --------------------------------------------------------------------------------------------------

    async def read_neighbourhood(self) -> list[Record]:
        """Return the devices in this device's own neighbourhood, including itself; all devices of an undivided team."""
        place = compute_prefix(self._own_id, max(0, self.depth - 1))
        records = await self.entangled.get(place.key)
        return [record for _, record in select_listed(place.key, records)] if self.depth else records

    async def list_devices(
        self,
        concern: ReadConsistency = "majority",
        under: Prefix = ROOT,
        on_found: Callable[[Listing], None] = lambda listing: None,
        pause: float = 0.0,
    ) -> Listing:
        """List all devices, or those below a prefix; ``on_found`` is called each time that more of them are known.

        A ``fast`` read costs a fifth of a majority read, but may miss recent changes.  Never fails: unread places are
        in ``Listing.missed``.  ``pause`` is the time in seconds between two batches of reads.
        """
        listing = Listing(max(0, self.depth - 1), under)

        async def visit(place: Prefix) -> None:
            try:
                return listing.add_records(place, await self.entangled.get(place.key, concern))
            except EntangledError:
                pass
            try:
                # If half of the replicas have failed at once, use the records of any other, but mark the place as
                # incomplete.
                listing.add_records(place, await self.entangled.get(place.key, "fast"))
                listing.missed.append(place)
            except EntangledError:
                listing.on_failure(place)

        while True:
            places = [place for _ in range(CONCURRENT_READS) if (place := listing.take_next()) is not None]
            if not places:
                return listing
            await run_limited(CONCURRENT_READS, map(visit, places))
            on_found(listing)
            if pause and not listing.is_over:
                await self.background.sleep(pause)

    async def find_devices(
        self, count: int, matches: Matches = lambda device: True, after: bytes | None = None, most_reads: int = 64
    ) -> Page:
        """Find ``count`` or more devices for which ``matches`` returns True, and the id to continue from.

        The search starts at the id ``after``, by default this device's own, so that different nodes ask different
        replicas, and continues around the id space.  It stops after ``most_reads`` places in any case.
        """
        begin = self._own_id if after is None else after
        depth = max(0, self.depth - PARTIAL_SEARCH_LEVELS)
        found: dict[bytes, Record] = {}
        is_complete, reads = True, 0
        place = compute_prefix(begin, depth)
        for _ in range(1 << depth):
            listing = await self.list_devices(under=place)
            is_complete &= listing.is_complete
            reads += listing.reads
            found.update((record.owner, record) for device, record in listing.devices if matches(device))
            place = Prefix(depth, (place.bits + 1) % (1 << depth))
            if place.has(self._own_id):
                return Page(list(found.values()), None, is_complete)
            if len(found) >= count or reads >= most_reads:
                break
        return Page(list(found.values()), place.first, is_complete)
