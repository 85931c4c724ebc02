"""Sync state of a replica: whether its replies count in a majority, and which replies it needs before they do.

A replica in state NEVER_SYNCED has never caught up with others.  In state STALE it once did, and holds all records that
it acknowledged since.  In state CURRENT it has caught up and been in contact with a majority since.
"""

from __future__ import annotations

from middleware.entangled.data.store import Store
from middleware.entangled.kademlia.overlay import K

NEVER_SYNCED, STALE, CURRENT = range(3)

NOTE_NAME = "settled"
"""The note of a node that was synced once: ``SETTLED``, or ``LOST`` if it then lost its records."""
SETTLED, LOST = b"1", b"lost"


class SyncState:
    """The sync state of one node; its owner clears ``is_synced`` when the node loses contact to a majority."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._was_synced = False
        self._has_lost = False
        self.is_synced = False

    def start(self, forgot: bool) -> None:
        """Load the state of the earlier run; ``forgot``: its records were dropped, though others may count on them."""
        noted = self._store.get_note(NOTE_NAME)
        is_bare = forgot or self._store.origin == "replaced" or self._store.corrupt_rows > 0
        self._has_lost = noted == LOST or (noted == SETTLED and is_bare)
        self._was_synced = noted == SETTLED and not is_bare
        if self._has_lost:
            self._store.set_note(NOTE_NAME, LOST)

    @property
    def value(self) -> int:
        """``NEVER_SYNCED``, ``STALE`` or ``CURRENT``."""
        return CURRENT if self.is_synced else STALE if self._was_synced else NEVER_SYNCED

    def set_synced(self) -> bool:
        """Become synced; return whether that is the first time, so that other nodes must learn of it."""
        is_first = not self._was_synced
        self.is_synced = self._was_synced = True
        self._has_lost = False
        if is_first:
            self._store.set_note(NOTE_NAME, SETTLED)
        return is_first

    def is_enough(self, reached: list[int | None], away: int) -> bool:
        """Return whether the nodes in ``reached`` together have every record that a majority has.

        ``reached`` lists the sync states of the nodes asked (None: failed); ``away`` more are absent.  A node that was
        never synced has no records to give and counts in no majority.  If a synced node answered, only synced nodes
        count, because the records of a stale node may stem from a time with other members.  A node that lost its
        records may have been one of the voters.  A new node is admitted by a majority of the nodes before it; otherwise
        each half of a partition could grow to a majority.
        """
        missing = reached.count(None) + away
        answered = reached.count(CURRENT) or reached.count(STALE)
        if self._has_lost:
            return missing + 1 < _majority(answered + missing + 1)
        if self._was_synced:
            return missing < _majority(answered + missing + (0 if CURRENT in reached else 1))
        return not missing or (answered > missing and missing < _majority(answered + missing))


def _majority(members: int) -> int:
    """Return the majority of the replicas of a key."""
    return min(members, K) // 2 + 1
