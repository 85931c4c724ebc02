"""Store: the records that a node holds, and the few facts that it keeps for itself.

``MemoryStore`` forgets when the node ends; ``sqlite.SqliteStore`` is the same with a file behind it.  Moments are in
seconds on one clock of the caller, who says when something expires and what the time is.

Where there is no room for a record, room is made in this order, and no further than is needed:

1. what has run out;
2. tombstones that are older than ``hold``, the oldest first: whoever was away for longer than that re-joins empty.

Nothing else is ever let go of for the sake of something: if that is not enough, the writer is told ``Full``, with
figures, and nothing has changed but 1.

One owner may have as much as it leaves free: a dynamic threshold, as in switches with a shared buffer (Choudhury and
Hahne, 1998).  Alone it has up to half of the rows and bytes; k owners that write without end leave 1 in 2**k free to
the others.  An owner that has more is refused, and only tombstones of its own make room for it.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, Protocol

from twisted.internet.defer import Deferred

from middleware.entangled.record import Record, Slot

MAX_ROWS = 12_000
"""Slots that a node holds.  More serves a larger network; less spares memory: 1.2 KiB a row beside what ``weight``
counts.  Full with ``MAX_BYTES`` a store adds some 22 MiB to a node of 40, which a device of 64 MB just bears."""
MAX_BYTES = 8 * 2**20
"""Bytes that a node holds, as ``weight`` counts them.  More holds more large values; less spares memory and card."""
HOLD = 86_400.0
"""Seconds for which a tombstone stays even where room is short: the longest absence after which a deleted record does
not come back with whoever was away.  More is safer; less gives room back earlier."""
OWNER_ROWS = 250
OWNER_BYTES = 65_536
"""Rows and bytes that each owner may have as long as there is room at all, however much others have."""
FIXED_BYTES = 17
"""Sequence (8), ttl (8) and lifetime (1) of a record."""

Origin = Literal["new", "kept", "replaced"]
"""Where a store comes from: made now, back from its file, or made now because its file was rotten."""
Durable = Literal["power", "crash"]
"""What that which is written outlives: any loss of power, or a crash of the process only."""


class Usage(NamedTuple):
    """What a store holds and may hold."""

    rows: int
    max_rows: int
    bytes: int
    max_bytes: int

    def __str__(self) -> str:
        return f"{self.rows} of {self.max_rows} rows, {self.bytes} of {self.max_bytes} bytes"


class Store(Protocol):
    """What every data store does; one thread uses it."""

    @property
    def epoch(self) -> bytes:
        """Eight bytes drawn when the store was made: others tell by them that a node lost what it had."""

    @property
    def origin(self) -> Origin:
        """Where the store comes from; what is not ``new`` to its node may be stale or empty until it is compared."""

    @property
    def rotten(self) -> int:
        """Rows that failed their checksum when the store was opened; they are absent, and its replicas repair them."""

    @property
    def usage(self) -> Usage:
        """Rows and bytes held, tombstones included, and how many may be."""

    @property
    def trouble(self) -> str:
        """Why nothing can be written at present; empty if it can."""

    def put(self, record: Record, expires_at: float, now: float | None = None) -> bool:
        """Hold ``record`` if it beats what its slot holds, and say whether it did.

        The very record that is already held only stays longer.  ``now``: what has run out by then makes room first.

        Raises ``Full`` where there is no room, or its owner has all that one owner may have, ``Unwritable`` where it
        cannot be written.  It is safe, and may be acknowledged, once ``written`` has fired.
        """

    def written(self) -> Deferred[None]:
        """Fire when all that was put until now survives the end of the process; fail with ``Unwritable`` if not."""

    def get(self, key: bytes, tombstones: bool = False) -> list[Record]:
        """The records under ``key`` in the order of (owner, name); ``tombstones``: with the empty slots."""

    def slot(self, slot: Slot) -> Record | None:
        """What ``slot`` holds, be it a tombstone."""

    def expiry(self, slot: Slot) -> float | None:
        """When what ``slot`` holds runs out, or None where it holds nothing."""

    def owned(self, owner: bytes) -> list[Record]:
        """The records of ``owner``, tombstones included, in the order of their slots."""

    def owners(self) -> list[bytes]:
        """Every owner that has a slot, in the order in which they came."""

    def extend(self, owner: bytes, expires_at: float) -> int:
        """Let all leased records of ``owner`` live until ``expires_at`` at least; returns how many there are."""

    def expire(self, now: float) -> list[Record]:
        """Let go of what has run out by ``now``; return it, the earliest first, and before it what had to make room."""

    def due(self) -> float:
        """The moment before which ``expire`` finds nothing to let go of; infinite where nothing is held."""

    def drop_leased(self, owner: bytes) -> list[Record]:
        """Let go of all leased records of ``owner`` (it said goodbye) and return them in the order of their slots."""

    def discard(self, slot: Slot) -> bool:
        """Let go of what ``slot`` holds, whatever its lifetime, and say whether it held anything."""

    def records(self) -> list[Record]:
        """Every record held, tombstones included, in the order in which their slots came."""

    def keys(self) -> list[bytes]:
        """Every key that has a slot, in the order in which they came."""

    def note(self, name: str, value: bytes) -> None:
        """Keep a small fact of the node's own (its seed, its contacts) under ``name``."""

    def noted(self, name: str) -> bytes | None:
        """The fact kept under ``name``, or None."""

    def close(self) -> None:
        """Write what is to be written and let go; may be called twice."""

    def __len__(self) -> int:
        """How many slots are held, the empty ones included."""


def weight(record: Record) -> int:
    """What ``record`` counts against a quota: the bytes of all its fields."""
    name = len(record.name.encode())
    return len(record.key) + len(record.owner) + name + len(record.value or b"") + len(record.signature) + FIXED_BYTES
