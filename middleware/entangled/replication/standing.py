"""Standing: whether what this node says about records counts, and whose word it needs before it does.

A *novice* never caught up with others; an *elder* once did, and holds what it acknowledged since; who is *sure* has
caught up and was in touch with a majority ever since.
"""

from __future__ import annotations

from middleware.entangled.data.store import Store
from middleware.entangled.kademlia.overlay import K

NOVICE, ELDER, SURE = range(3)

NOTE = "settled"
"""The note of a node that once was sure, ``SETTLED``, or was and then lost what it held, ``LOST``."""
SETTLED, LOST = b"1", b"lost"


class Standing:
    """What one node remembers of its part in majorities; ``is_sure`` is for its caller to take back."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._is_elder = False
        self._has_lost = False
        self.is_sure = False

    def start(self, forgot: bool) -> None:
        """Take up the earlier life; ``forgot``: what it held is not here any more, though others may count on it."""
        noted = self._store.noted(NOTE)
        is_bare = forgot or self._store.origin == "replaced" or self._store.rotten > 0
        self._has_lost = noted == LOST or (noted == SETTLED and is_bare)
        self._is_elder = noted == SETTLED and not is_bare
        if self._has_lost:
            self._store.note(NOTE, LOST)

    @property
    def now(self) -> int:
        """``NOVICE``, ``ELDER`` or ``SURE``."""
        return SURE if self.is_sure else ELDER if self._is_elder else NOVICE

    def settle(self) -> bool:
        """Be sure from now on; whether that is news to those who count members."""
        is_first = not self._is_elder
        self.is_sure = self._is_elder = True
        self._has_lost = False
        if is_first:
            self._store.note(NOTE, SETTLED)
        return is_first

    def is_enough(self, reached: list[int | None], away: int) -> bool:
        """Whether whatever a majority holds is held by one of those reached, whose standings these are (None: failed).

        ``away`` more are absent.  A novice has nothing to tell, and no part in a majority.  Where somebody is sure,
        only such count: elders may come from a time when there were other members.  A memory that was lost may have
        been one vote.  A newcomer is let in by a majority of those before it, or each half could grow to one.
        """
        missing = reached.count(None) + away
        heard = reached.count(SURE) or reached.count(ELDER)
        if self._has_lost:
            return missing + 1 < _majority(heard + missing + 1)
        if self._is_elder:
            return missing < _majority(heard + missing + (0 if SURE in reached else 1))
        return not missing or (heard > missing and missing < _majority(heard + missing))


def _majority(members: int) -> int:
    """How many of the holders of a key are a majority of them."""
    return min(members, K) // 2 + 1
