"""Outlet: where an emulator's bytes leave, with the faults that its switches say."""

from __future__ import annotations

import random

from twisted.internet.interfaces import IReactorTime

from drivers.link import Link
from middleware.faults.stream import StreamFaults


class Outlet:
    """One link to a driver, or none; what is sent without one is lost."""

    def __init__(self, clock: IReactorTime, rng: random.Random, faults: StreamFaults) -> None:
        self.link: Link | None = None
        self._clock = clock
        self._rng = rng
        self._faults = faults

    def send(self, data: bytes) -> None:
        """Send ``data``, or what is left of it."""
        for piece in self._faults.wire(data, self._rng):
            if self._faults.delay > 0.0:
                self._clock.callLater(self._faults.delay, self._leave, piece)
            else:
                self._leave(piece)

    def _leave(self, data: bytes) -> None:
        if self.link is not None:
            self.link.send(data)
