"""Token bucket: how often something may happen, or how much of it; pure."""

from __future__ import annotations


class TokenBucket:
    """``rate`` tokens come in a second, up to ``size`` (None: what one second brings); it is full at first.

    ``now`` is in seconds; a clock that was set back brings nothing.
    """

    __slots__ = ("_rate", "_size", "_tokens", "_filled_at")

    def __init__(self, rate: float, size: float | None = None) -> None:
        self._rate = rate
        self._size = self._tokens = rate if size is None else size
        self._filled_at = 0.0

    def take(self, now: float, amount: float = 1.0) -> bool:
        """Whether there is so much; it is gone then."""
        passed, self._filled_at = now - self._filled_at, now
        if passed > 0.0:
            self._tokens = min(self._size, self._tokens + passed * self._rate)
        if self._tokens < amount:
            return False
        self._tokens -= amount
        return True

    def give(self) -> None:
        """Put back one token that was taken for nothing."""
        self._tokens = min(self._size, self._tokens + 1.0)

    def is_full(self, now: float) -> bool:
        """Whether it is as good as a new one."""
        return self._tokens + (now - self._filled_at) * self._rate >= self._size
