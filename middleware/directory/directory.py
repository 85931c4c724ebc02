"""Directory: this node's part in the list of all devices, which is split by prefix in a large team.

It knows where the own device stands, moves it as the team grows and shrinks, and reads what others wrote.  Where a
device stands is decided in ``prefix``, how a list is walked in ``listing``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from twisted.internet.defer import Deferred, DeferredList

from middleware.directory.listing import Listing, standing
from middleware.directory.prefix import ROOT, Prefix, depth_for, lease_at, places_of, prefix_of, size_of
from middleware.directory.presence import Device
from middleware.entangled.background import Background, paced
from middleware.entangled.errors import EntangledError
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record
from middleware.entangled.replication.reader import ReadConcern

AT_ONCE = 8
"""Places that one list reads at the same time."""
PLACED, PLACED_STEP = 50, 0.1
"""Steps for which a newcomer waits until it knows its neighbours, and seconds of each."""
WIDER = 2
"""How many depths above its own a device begins that wants to see some of the others only: four places or so."""

Matches = Callable[[Device], bool]


class Page(NamedTuple):
    """Some of the devices: those found first from a place on, and the id where the next ones begin (None: no more).

    ``is_complete`` says whether nobody was left out in between.
    """

    records: list[Record]
    following: bytes | None
    is_complete: bool


class Directory:
    """The directory as the node ``entangled`` sees it."""

    def __init__(self, entangled: EntangledNode, chores: Background) -> None:
        self.depth = 0
        self.entangled = entangled
        self.chores = chores
        self._own_id = entangled.identity.node_id
        self._stands: set[tuple[bytes, str]] = set()
        self._leaves: set[tuple[bytes, str]] = set()

    @property
    def size(self) -> int:
        """About how many devices there are; as many as are known where nobody says that there are more."""
        overlay = self.entangled.overlay
        contacts = overlay.contacts()
        is_large = overlay.roster.is_full or (overlay.is_large and not overlay.is_complete)
        return size_of(self._own_id, contacts) if is_large else len(contacts) + 1

    @property
    def lease(self) -> float:
        """Seconds that this device is listed after its last sign of life."""
        return lease_at(self.depth, self.entangled.lease)

    # -- where this device stands -----------------------------------------------------------------------------------

    async def arrive(self) -> int:
        """The depth to begin with.  In a large team a newcomer first learns who its neighbours are."""
        overlay = self.entangled.overlay
        for _ in range(PLACED):
            if overlay.is_placed or not overlay.is_large:
                break
            await self.chores.sleep(PLACED_STEP)
        self.depth = depth_for(self.size)
        return self.depth

    def review(self) -> int:
        """The depth at which the device is to be from now on: one more or less where the team is of another size."""
        self.depth = depth_for(self.size, self.depth)
        return self.depth

    def announce(self, name: str, value: bytes, depth: int) -> Deferred[Any]:
        """Write what the device says of itself, packed, where it stands at ``depth``; then leave where it stood."""
        lease = lease_at(depth, self.entangled.lease)
        stands = {(key, name) for key in places_of(self._own_id, depth)}
        self._leaves = (self._leaves | self._stands) - stands
        self._stands = stands
        puts = [self.entangled.put(key, name, value, "leased", lease=lease) for key in places_of(self._own_id, depth)]
        return puts[0] if len(puts) == 1 and not self._leaves else self._moved(puts)

    def _moved(self, puts: list[Deferred[Any]]) -> Deferred[Any]:
        def left(results: Any) -> None:
            for key, name in self._leaves:
                self.entangled.release(key, name)
            self._leaves.clear()

        def failed(failure: Any) -> Any:
            return failure.value.subFailure  # where it stood it stays, until it says something again

        return DeferredList(puts, fireOnOneErrback=True, consumeErrors=True).addCallbacks(left, failed)

    # -- who else is there ------------------------------------------------------------------------------------------

    async def around(self) -> list[Record]:
        """The devices of this device's own neighbourhood, itself included: all there are in a team with one place."""
        place = prefix_of(self._own_id, max(0, self.depth - 1))
        records = await self.entangled.get(place.key)
        return [record for _, record in standing(place.key, records)] if self.depth else records

    async def listed(
        self,
        concern: ReadConcern = "majority",
        under: Prefix = ROOT,
        heard: Callable[[Listing], None] = lambda listing: None,
        pause: float = 0.0,
    ) -> Listing:
        """All devices, or those below a prefix; ``heard`` is told each time that more of them are known.

        A ``fast`` read costs a fifth, and may lack who has just come or gone.  Never fails: what could not be read is
        named in ``Listing.missed``.  Between two lots of reads it rests for ``pause`` seconds.
        """
        listing = Listing(max(0, self.depth - 1), under)

        async def visit(place: Prefix) -> None:
            try:
                return listing.read(place, await self.entangled.get(place.key, concern))
            except EntangledError:
                pass
            try:
                # Half of the holders went at once: what any of the others has is better than nothing, and not all.
                listing.read(place, await self.entangled.get(place.key, "fast"))
                listing.missed.append(place)
            except EntangledError:
                listing.failed(place)

        while True:
            places = [place for _ in range(AT_ONCE) if (place := listing.next()) is not None]
            if not places:
                return listing
            await paced(AT_ONCE, map(visit, places))
            heard(listing)
            if pause and not listing.is_over:
                await self.chores.sleep(pause)

    async def some(
        self, count: int, matches: Matches = lambda device: True, after: bytes | None = None, most_reads: int = 64
    ) -> Page:
        """At least ``count`` devices that ``matches`` wants, unless there are fewer, and where to go on.

        They come neighbourhood by neighbourhood, from the id ``after`` on and round the ring of ids; by default this
        device's own one comes first, so that those who ask for a page ask different holders.  After ``most_reads``
        places it stops in any case: a search for what nobody has costs no more than that, and can be gone on with.
        """
        begin = self._own_id if after is None else after
        depth = max(0, self.depth - WIDER)
        found: dict[bytes, Record] = {}
        is_complete, reads = True, 0
        place = prefix_of(begin, depth)
        for _ in range(1 << depth):
            listing = await self.listed(under=place)
            is_complete &= listing.is_complete
            reads += listing.reads
            found.update((record.owner, record) for device, record in listing.devices if matches(device))
            place = Prefix(depth, (place.bits + 1) % (1 << depth))
            if place.has(self._own_id):
                return Page(list(found.values()), None, is_complete)
            if len(found) >= count or reads >= most_reads:
                break
        return Page(list(found.values()), place.first, is_complete)
