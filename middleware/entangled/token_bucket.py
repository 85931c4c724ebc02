"""Limit a rate with a token bucket."""

from __future__ import annotations


class TokenBucket:
    """A bucket that gains ``rate`` tokens per second up to ``size`` (None: the tokens of one second), initially full.

    ``now`` is in seconds; a clock that was set back adds nothing.
    """

    __slots__ = ("_rate", "_size", "_tokens", "_filled_at")

    def __init__(self, rate: float, size: float | None = None) -> None:
        self._rate = rate
        self._size = self._tokens = rate if size is None else size
        self._filled_at = 0.0

    def take(self, now: float, amount: float = 1.0) -> bool:
        """Take ``amount`` tokens if there are enough; return whether there were."""
        passed, self._filled_at = now - self._filled_at, now
        if passed > 0.0:
            self._tokens = min(self._size, self._tokens + passed * self._rate)
        if self._tokens < amount:
            return False
        self._tokens -= amount
        return True

    def refund(self) -> None:
        """Return one token that was not used."""
        self._tokens = min(self._size, self._tokens + 1.0)

    def is_full(self, now: float) -> bool:
        """Return whether the bucket is full."""
        return self._tokens + (now - self._filled_at) * self._rate >= self._size
