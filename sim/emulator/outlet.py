"""Outlet: where an emulator's bytes leave, as foul as its switches say."""

from __future__ import annotations

import random

from twisted.internet.interfaces import IReactorTime

from drivers.link import Link
from sim.emulator.foul import Foul


class Outlet:
    """One link to a driver, or none; what is sent without one is lost."""

    def __init__(self, clock: IReactorTime, rng: random.Random, foul: Foul) -> None:
        self.link: Link | None = None
        self._clock = clock
        self._rng = rng
        self._foul = foul

    def send(self, data: bytes) -> None:
        """Send ``data``, or what is left of it."""
        for piece in self._foul.wire(data, self._rng):
            if self._foul.delay > 0.0:
                self._clock.callLater(self._foul.delay, self._leave, piece)
            else:
                self._leave(piece)

    def _leave(self, data: bytes) -> None:
        if self.link is not None:
            self.link.send(data)
