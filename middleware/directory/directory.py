"""The directory: the list of all devices, split by prefix in a large team.

It writes the record of this node's device, moves the record when the size of the team changes, and reads the records of
other devices.  ``prefix`` computes the keys under which a device is listed, and ``listing`` the keys to read.
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
"""Number of keys that one listing reads concurrently."""
PLACEMENT_STEPS, PLACEMENT_STEP_S = 50, 0.1
"""A new node waits at most this number of steps until it knows its neighbours; each step takes the given seconds."""
PARTIAL_SEARCH_LEVELS = 2
"""A device starts a partial search this number of levels above its own depth, and so reads about four keys."""

Matches = Callable[[Device], bool]


class Page(NamedTuple):
    """Some of the devices.

    ``next_id`` is the id from which the search continues (None: all devices were searched).  ``is_complete`` is False
    if devices in the searched range may be missing.
    """

    records: list[Record]
    next_id: bytes | None
    is_complete: bool


class Directory:
    """The directory as used by the node ``entangled``."""

    def __init__(self, entangled: EntangledNode, background: Background) -> None:
        self.depth = 0
        self.entangled = entangled
        self.background = background
        self._own_id = entangled.identity.node_id
        self._current_places: set[tuple[bytes, str]] = set()
        self._old_places: set[tuple[bytes, str]] = set()

    @property
    def size(self) -> int:
        """The estimated number of nodes; in a small team the number of known nodes, including this one."""
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
        """Return the initial depth; in a large team, first wait until this node knows its neighbours."""
        overlay = self.entangled.overlay
        for _ in range(PLACEMENT_STEPS):
            if overlay.has_found_neighbours or not overlay.is_large:
                break
            await self.background.sleep(PLACEMENT_STEP_S)
        self.depth = choose_depth(self.size)
        return self.depth

    def update_depth(self) -> int:
        """Update and return the depth, which changes by at most one when the size of the team has changed."""
        self.depth = choose_depth(self.size, self.depth)
        return self.depth

    def announce(self, name: str, value: bytes, depth: int) -> Deferred[Any]:
        """Write the device's packed record under its keys at ``depth``, then release its previous keys."""
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
            return failure.value.subFailure  # the record stays under the previous keys until the next announcement

        return DeferredList(puts, fireOnOneErrback=True, consumeErrors=True).addCallbacks(record_left, failed)

    # -- other devices
    # --------------------------------------------------------------------------------------------------

    async def read_neighbourhood(self) -> list[Record]:
        """Return the records of this device and its neighbours, or of all devices if the directory is not split."""
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
        """List all devices, or those with the prefix ``under``; call ``on_found`` after each batch of reads.

        This method never fails: keys that could not be read are in ``Listing.missed``.  With ``fast``, a read costs a
        fifth of a majority read, but may miss recent changes.  ``pause`` is the time in seconds between two batches of
        reads.
        """
        listing = Listing(max(0, self.depth - 1), under)

        async def visit(place: Prefix) -> None:
            try:
                return listing.add_records(place, await self.entangled.get(place.key, concern))
            except EntangledError:
                pass
            try:
                # If no majority of replicas answers, use the records of any replica, but mark this part as incomplete.
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
        """Find ``count`` or more devices for which ``matches`` returns True.

        The search starts at the id ``after`` and continues around the id space.  By default it starts at this device's
        own id, so that different nodes read from different replicas.  It stops after ``most_reads`` reads in any case;
        the page contains the id from which to continue.
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
