"""Paced: what yards have in common, whoever lives in them: a clock paces them, and drivers come over connections."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from twisted.internet.interfaces import IDelayedCall, IReactorTime

from drivers.link import Link, MemoryConnector
from drivers.sim.codec import Message
from sim.robots.reception import Legs, Reception
from sim.robots.session import Session
from sim.robots.world import TICK

MAX_LATE_S = 1.0
"""Seconds by which a yard may be late and still make up for them."""


class PacedYard:
    """A yard of the robots ``names``; ``start`` lets its time run on ``clock``, ``attach`` takes a connection.

    ``legs``, ``most`` and ``other`` are those of its ``Reception``.
    """

    def __init__(
        self,
        clock: IReactorTime,
        names: Iterable[str],
        legs: Legs,
        most: int,
        other: Callable[[Session, Message], None] = lambda session, message: None,
    ) -> None:
        self._clock = clock
        self._reception = Reception(names, legs, self._now, most, other)
        self._origin = clock.seconds()
        self._ticks = 0
        self._pending: IDelayedCall | None = None

    @property
    def holders(self) -> list[str]:
        """The robots that a driver holds now."""
        return [name for name in self._reception.gates if name in self._reception.holders]

    def start(self) -> None:
        """Let time run from now on."""
        self._origin = self._clock.seconds() - self._ticks * TICK
        self._schedule()

    def stop(self) -> None:
        """Let time stand still, and close every connection."""
        if self._pending is not None:
            self._pending.cancel()
            self._pending = None
        self._reception.close()

    def attach(self, link: Link) -> Session:
        """Take a new connection; what arrives on it goes to the session that is returned."""
        return self._reception.attach(link)

    def connector(self, delay: float = 0.0005) -> MemoryConnector:
        """What drivers in this process connect through: ``SimDriver(options, yard.connector(), clock)``."""
        return MemoryConnector(self._clock, self.attach, delay)

    def _play(self, late: float) -> int:
        """Let the tick that is due pass, and of those that are ``late``, in seconds, as many as wanted; how many."""
        raise NotImplementedError

    def _now(self) -> float:
        """The yard's time between the ticks too, in seconds since its start."""
        return self._clock.seconds() - self._origin

    def _schedule(self) -> None:
        self._pending = self._clock.callLater(max(0.0, (self._ticks + 1) * TICK - self._now()), self._turn)

    def _turn(self) -> None:
        late = self._now() - (self._ticks + 1) * TICK
        if late > MAX_LATE_S:
            # After a suspended machine nobody wants the lost minutes back at once, nor what was ordered before them.
            self._origin += late
            late = 0.0
            self._reception.halt()
        self._ticks += self._play(late)
        self._schedule()
