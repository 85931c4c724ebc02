"""Keep operations of one node in flight, and count the results."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

MAX_BATCH = 64
"""Operations started at a time: reads from the node's own store end immediately, so the loop must run in between."""


class Load:
    """Keep ``order["in_flight"]`` operations open for ``order["seconds"]``, each item ``once`` or repeatedly.

    An operation is good only if it ended successfully and in time. Operations that were still open at the end, or were
    not started, are not good. If each item is used once, "done" lists the good operations.
    """

    def __init__(
        self,
        timed: Callable[..., None],
        later: Callable[..., Callable[[], None]],
        order: dict[str, Any],
        answer: Callable[..., None],
    ) -> None:
        self._start_timed = timed
        self._call_later = later
        self._answer = answer
        self._kind: str = order["kind"]
        self._items = [(key, bytes.fromhex(value)) for key, value in order["items"]]
        self._in_flight: int = order["in_flight"]
        self._once: bool = order["once"]
        self._limit_s: float = order["limit_s"]
        self._began = time.monotonic()
        self._ends_at = self._began + order["seconds"]
        self._next = 0
        self._open = 0
        self._filling = False
        self._ended = False
        self._results: list[tuple[str, bool, float]] = []
        later(order["seconds"] + 0.05, self._end)

    def fill(self) -> None:
        """Start as many operations as may be in flight."""
        if self._filling or self._ended:
            return
        self._filling = True
        begun = 0
        while self._open < self._in_flight and self._has_more() and begun < MAX_BATCH:
            key, value = self._items[self._next % len(self._items)]
            self._next += 1
            self._open += 1
            begun += 1
            self._start_timed(
                self._kind, key, value, self._limit_s, lambda good, ms, key=key: self._on_done(key, good, ms)
            )
        self._filling = False
        if begun == MAX_BATCH:
            self._call_later(0, self.fill)
        elif not self._open:
            self._end()

    def _has_more(self) -> bool:
        return time.monotonic() < self._ends_at and not (self._once and self._next >= len(self._items))

    def _on_done(self, key: str, is_good: bool, ms: float) -> None:
        self._open -= 1
        if not self._ended:
            self._results.append((key, is_good, ms))
            self.fill()

    def _end(self) -> None:
        if self._ended:
            return
        self._ended = True
        good = [(key, ms) for key, is_good, ms in self._results if is_good]
        self._answer(
            seconds=time.monotonic() - self._began,
            good=len(good),
            tried=len(self._results),
            unfinished=self._open,
            ms=sorted(round(ms, 3) for _, ms in good),
            done=[key for key, _ in good] if self._once else [],
        )
