"""Bucket: how often something may happen; pure."""

from __future__ import annotations


class Bucket:
    """``most`` at once, and ``rate`` a second in the long run; ``now`` is in seconds."""

    def __init__(self, most: float, rate: float) -> None:
        self._most = most
        self._rate = rate
        self._left = most
        self._at = 0.0

    def take(self, now: float) -> bool:
        """Take one, if there is one."""
        self._left = min(self._most, self._left + self._rate * max(0.0, now - self._at))
        self._at = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True
