"""The tuples of one space and arity, updated as long as calls wait for them.

Pushes of a watch wake the waiting calls.  In addition the node polls the replicas, so a failure of the pushing replicas
delays a call by less than a second.
"""

from __future__ import annotations

from collections.abc import Callable

from twisted.internet.defer import Deferred

from middleware.entangled.background import Background
from middleware.entangled.record import Record
from middleware.entangled.replication.watch import Watch
from middleware.entangled.space.node_interface import NodeInterface
from middleware.entangled.space.tuple_record import RecordParser, StoredTuple

POLL_INTERVAL_S = 0.7
"""Seconds between two polls.  This interval and the duration of a poll must together be less than one second, the
maximum delay of a waiting call."""
LINGER_S = 5.0
"""Seconds for which a watch continues after its last waiting call, so that calls in a loop share one subscription."""


class TupleCache:
    """The tuples under ``key``; ``tuples`` are the tuples that are not known to be taken."""

    def __init__(self, node: NodeInterface, key: bytes, background: Background) -> None:
        self.key = key
        self.tuples: list[StoredTuple] = []
        self._node = node
        self._background = background
        self._parser = RecordParser()
        self._watch: Watch | None = None
        self._wait_count = 0
        self._was_called = False
        self._sleepers: dict[Deferred[None], None] = {}
        self._stop_polling: Callable[[], None] = lambda: None
        self._stop_lingering: Callable[[], None] = lambda: None

    @property
    def is_open(self) -> bool:
        """Whether the tuples are currently updated."""
        return self._watch is not None

    def start_waiting(self) -> None:
        """Register a waiting call; ``stop_waiting`` must follow."""
        self._wait_count += 1
        self._stop_lingering()
        if self._watch is None:
            self._watch = self._node.watch(self.key, self._on_changed)
            self._on_changed(self._watch.records)
        if self._wait_count == 1:
            self._stop_polling = self._background.later(POLL_INTERVAL_S, self._poll)

    def stop_waiting(self) -> None:
        """Unregister a waiting call."""
        self._wait_count -= 1
        if not self._wait_count:
            self._stop_polling()
            self._stop_lingering = self._background.later(LINGER_S, self.close)

    def record_call(self) -> None:
        """Record a call that does not wait; the second call within ``LINGER_S`` seconds starts the updates."""
        if self._was_called:
            self.start_waiting()
            self.stop_waiting()
        else:
            self._was_called = True
            self._background.later(LINGER_S, self._forget_call)

    def close(self) -> None:
        """End the watch; the next call that waits starts it again."""
        if self._watch is not None:
            self._watch.stop()
            self._watch = None

    async def sleep(self, seconds: float | None) -> None:
        """Return when the tuples change, when ``wake`` is called, or after ``seconds``."""
        woken: Deferred[None] = Deferred()
        self._sleepers[woken] = None
        rest = self._background.later(seconds, self._wake_one, woken) if seconds is not None else lambda: None
        await woken
        rest()

    def wake(self) -> None:
        """Wake all calls that sleep."""
        for woken in list(self._sleepers):
            self._wake_one(woken)

    def _forget_call(self) -> None:
        self._was_called = False

    def _wake_one(self, woken: Deferred[None]) -> None:
        if woken in self._sleepers:
            del self._sleepers[woken]
            woken.callback(None)

    def _on_changed(self, records: list[Record]) -> None:
        before = {one.tuple_id for one in self.tuples}
        self.tuples, _ = self._parser.parse(records)
        if any(one.tuple_id not in before for one in self.tuples):
            self.wake()

    def _poll(self) -> None:
        self._stop_polling = self._background.later(POLL_INTERVAL_S, self._poll)
        if self._watch is not None:
            self._node.refresh(self._watch)
