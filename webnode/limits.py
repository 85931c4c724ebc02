"""Limit the connections and requests that one address may have open at the same time."""

from __future__ import annotations

from collections import Counter
from typing import Literal

CountedKind = Literal["unfinished", "stream", "open"]
"""Incomplete requests, responses in progress (streams and long polls included), and connections."""
MAX_OPEN: dict[CountedKind, int] = {"unfinished": 16, "stream": 128, "open": 256}
"""A browser sends requests whole, so 16 incomplete requests are many even for a classroom behind one address."""


class AddressLimits:
    """Counts the open connections and requests of each address."""

    def __init__(self, max_open: dict[CountedKind, int] = MAX_OPEN) -> None:
        self._max_open = max_open
        self._counts: Counter[tuple[CountedKind, str]] = Counter()

    def can_open(self, kind: CountedKind, address: str) -> bool:
        """Return whether the address may open one more of ``kind``."""
        return self._counts[kind, address] < self._max_open[kind]

    def count(self, kind: CountedKind, address: str, by: int) -> None:
        """Add 1 or -1 to the count of the address; addresses with a count of 0 are not stored."""
        self._counts[kind, address] += by
        if not self._counts[kind, address]:
            del self._counts[kind, address]

    def get_total(self, kind: CountedKind) -> int:
        """Return the total of all addresses."""
        return sum(count for (each, _), count in self._counts.items() if each == kind)
