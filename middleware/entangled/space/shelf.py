"""Shelf: the tuples of one space and arity as a node sees them while somebody waits for them.

Pushes of the watch wake who waits; in between the holders are asked now and then whether they hold anything else, so
that the loss of those that had promised a push costs less than a second.
"""

from __future__ import annotations

from collections.abc import Callable

from twisted.internet.defer import Deferred

from middleware.entangled.background import Background
from middleware.entangled.record import Record
from middleware.entangled.replication.watch import Watch
from middleware.entangled.space.peer import Peer
from middleware.entangled.space.posting import Posted, Reader

POLL = 0.7
"""Seconds; a poll and the answers to it must fit into the one second that a wake-up may take."""
LINGER = 5.0
"""Seconds that a watch outlives the last who waited: who gets in a loop does not subscribe each time."""


class Shelf:
    """What stands under ``key``; ``posted`` are the tuples that nobody took, as far as is known."""

    def __init__(self, node: Peer, key: bytes, chores: Background) -> None:
        self.key = key
        self.posted: list[Posted] = []
        self._node = node
        self._chores = chores
        self._reader = Reader()
        self._watch: Watch | None = None
        self._waiting = 0
        self._is_visited = False
        self._sleepers: dict[Deferred[None], None] = {}
        self._stop_polling: Callable[[], None] = lambda: None
        self._stop_lingering: Callable[[], None] = lambda: None

    @property
    def is_open(self) -> bool:
        """Whether the shelf is kept up to date now."""
        return self._watch is not None

    def enter(self) -> None:
        """Wait here; ``leave`` must follow."""
        self._waiting += 1
        self._stop_lingering()
        if self._watch is None:
            self._watch = self._node.watch(self.key, self._changed)
            self._changed(self._watch.records)
        if self._waiting == 1:
            self._stop_polling = self._chores.later(POLL, self._poll)

    def leave(self) -> None:
        """Wait no longer."""
        self._waiting -= 1
        if not self._waiting:
            self._stop_polling()
            self._stop_lingering = self._chores.later(LINGER, self.close)

    def visit(self) -> None:
        """Look in: for who comes again soon the shelf is kept up to date, which spares reading it each time."""
        if self._is_visited:
            self.enter()
            self.leave()
        else:
            self._is_visited = True
            self._chores.later(LINGER, self._forget_visit)

    def close(self) -> None:
        """End the watch; the next who enters starts it again."""
        if self._watch is not None:
            self._watch.stop()
            self._watch = None

    async def sleep(self, seconds: float | None) -> None:
        """Return at the next change, when woken, or after ``seconds``."""
        woken: Deferred[None] = Deferred()
        self._sleepers[woken] = None
        rest = self._chores.later(seconds, self._rouse, woken) if seconds is not None else lambda: None
        await woken
        rest()

    def wake(self) -> None:
        """Rouse everybody who sleeps."""
        for woken in list(self._sleepers):
            self._rouse(woken)

    def _forget_visit(self) -> None:
        self._is_visited = False

    def _rouse(self, woken: Deferred[None]) -> None:
        if woken in self._sleepers:
            del self._sleepers[woken]
            woken.callback(None)

    def _changed(self, records: list[Record]) -> None:
        before = {one.place for one in self.posted}
        self.posted, _ = self._reader.standing(records)
        if any(one.place not in before for one in self.posted):
            self.wake()

    def _poll(self) -> None:
        self._stop_polling = self._chores.later(POLL, self._poll)
        if self._watch is not None:
            self._node.refresh(self._watch)
