"""Pace: how many are due by now, at so many a second; pure but for the clock."""

from __future__ import annotations

from twisted.internet.interfaces import IReactorTime


class Pace:
    """``rate`` a second, from when ``due`` is first asked on; ``most`` in all, 0 without end."""

    def __init__(self, clock: IReactorTime, rate: float, most: int = 0) -> None:
        self._clock = clock
        self._rate = rate
        self._most = most
        self._began: float | None = None
        self._given = 0

    @property
    def is_over(self) -> bool:
        """Whether as many were due as ever will be."""
        return bool(self._most) and self._given >= self._most

    def due(self) -> int:
        """How many became due since this was asked last."""
        now = self._clock.seconds()
        if self._began is None:
            self._began = now
        total = int((now - self._began) * self._rate + 1e-9)
        if self._most:
            total = min(total, self._most)
        due, self._given = total - self._given, total
        return due
