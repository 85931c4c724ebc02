"""Limits: how much one address may have open at once; whoever opens something counts it, and again when it ends."""

from __future__ import annotations

from collections import Counter
from typing import Literal

Kept = Literal["unfinished", "stream", "open"]
"""Requests that are not complete, answers that are under way (streams and long polls among them), connections."""
MOST: dict[Kept, int] = {"unfinished": 16, "stream": 128, "open": 256}
"""A browser sends its requests whole; so 16 that are not are many, even of a classroom that comes by one address."""


class AddressLimits:
    """Counts what each address has open."""

    def __init__(self, most: dict[Kept, int] = MOST) -> None:
        self._most = most
        self._counts: Counter[tuple[Kept, str]] = Counter()

    def may(self, kind: Kept, address: str) -> bool:
        """Whether it may have one more."""
        return self._counts[kind, address] < self._most[kind]

    def count(self, kind: Kept, address: str, by: int) -> None:
        """Count one more (1), or one less (-1); nothing is kept of an address that has none."""
        self._counts[kind, address] += by
        if not self._counts[kind, address]:
            del self._counts[kind, address]

    def total(self, kind: Kept) -> int:
        """How many there are of all addresses."""
        return sum(count for (each, _), count in self._counts.items() if each == kind)
