"""The sync state of a replica: whether its replies are counted in majorities, and when it becomes synced.

A replica in the state NEVER_SYNCED has never caught up with other replicas.  A replica in the state STALE has caught up
at some time, and stores all records that it has acknowledged since.  A replica in the state CURRENT has caught up, and
has stayed in contact with a majority.
"""

from __future__ import annotations

from middleware.entangled.data.store import Store
from middleware.entangled.kademlia.overlay import K

NEVER_SYNCED, STALE, CURRENT = range(3)

NOTE_NAME = "settled"
"""The name of the note of a node that has been synced: ``SETTLED``, or ``LOST`` if it lost its records afterwards."""
SETTLED, LOST = b"1", b"lost"


class SyncState:
    """The sync state of one node; ``Handover`` clears ``is_synced`` when the node loses contact to a majority."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._was_synced = False
        self._has_lost = False
        self.is_synced = False

    def start(self, forgot: bool) -> None:
        """Load the state from before the restart; ``forgot``: records were dropped, but other nodes rely on them."""
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
        """Mark this node as synced; return True the first time: the caller must then notify the other nodes."""
        is_first = not self._was_synced
        self.is_synced = self._was_synced = True
        self._has_lost = False
        if is_first:
            self._store.set_note(NOTE_NAME, SETTLED)
        return is_first

    def is_enough(self, reached: list[int | None], away: int) -> bool:
        """Return whether the nodes in ``reached`` together have every record that a majority has.

        ``reached`` contains the sync states of the nodes that were asked (None: no answer); ``away`` is the number of
        further nodes, which are absent.  A node that was never synced has no records to send and is not counted in
        majorities.  If a synced node answered, only synced nodes are counted, because the records of a stale node may
        be from a time with different members.  A node that lost its records may have been one of the voters.  A new
        node is admitted by a majority of the earlier nodes; otherwise each half of a partition could grow to a
        majority.
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
