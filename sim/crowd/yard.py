"""CrowdYard: a crowd whose first robots are driven over the yard's own wire; a controller has the others."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from random import Random
from typing import Any

from twisted.internet.interfaces import IReactorTime

from drivers.link import Link, MemoryConnector
from sim.crowd.body import CrowdBody
from sim.crowd.controller import Controller, Senses, wander
from sim.crowd.crowd import TICK, Crowd
from sim.crowd.eye import Eyes
from sim.crowd.feeling import Feelings, sampled
from sim.crowd.ground import Ground
from sim.reception import Reception
from sim.scene import SceneError
from sim.session import Session

MAX_LATE_S = 1.0
SPARE = 8
"""Connections beside one for each robot that can be driven."""


class CrowdYard:
    """A yard for many; ``start`` lets its time run on ``clock``, ``attach`` takes a connection.

    The first ``driven`` robots, ``robot1`` and so on, obey drivers and stand while nobody holds them; the others do
    what ``controller`` says.  ``stopwatch`` counts what was spent in ``moving`` and in ``telling`` the drivers.
    """

    def __init__(
        self,
        clock: IReactorTime,
        rng: Random,
        ground: Ground,
        driven: int = 0,
        controller: Controller = wander,
        stopwatch: Callable[[], float] = lambda: 0.0,
    ) -> None:
        if type(driven) is not int or not 0 <= driven <= ground.bodies:
            raise SceneError(
                f"driven must be a whole number from 0 to {ground.bodies}, the robots here, not {driven!r}"
            )
        self.crowd = Crowd(rng.getrandbits(64), ground)
        self.names = [f"robot{number}" for number in range(1, driven + 1)]
        self.moving = self.telling = 0.0
        self._clock = clock
        self._controller = controller
        self._others = Senses(self.crowd, driven)
        self._feelings = Feelings(rng.getrandbits(64), self.crowd, self.names)
        self._eyes = Eyes(Random(rng.getrandbits(64)), self.crowd)
        self._numbers = {name: number for number, name in enumerate(self.names)}
        self._reception = Reception(self.names, self, self._now, driven + SPARE)
        self._stopwatch = stopwatch
        self._origin = clock.seconds()
        self._pending: Any = None

    @property
    def holders(self) -> list[str]:
        """The robots that a driver holds now."""
        return [name for name in self.names if name in self._reception.holders]

    def start(self) -> None:
        """Let time run from now on."""
        self._origin = self._clock.seconds() - self.crowd.t
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

    def lend(self, name: str) -> CrowdBody:
        """Hand a robot over to an emulator, which moves it from now on; no driver may hold it here.

        Raises ``UsageError`` where there is no such robot to be driven.
        """
        self._reception.lend(name)
        return CrowdBody(self._numbers[name], self.crowd, self._feelings, self._eyes)

    def drive(self, name: str, vx: float, vy: float, wz: float) -> None:
        """Let the robot ``name`` walk with this velocity in its own frame until told otherwise."""
        self.crowd.wish[self._numbers[name]] = (vx, vy, wz)

    def halt(self, name: str) -> None:
        """Let the robot ``name`` stand still, as fast as its legs can brake."""
        self.crowd.wish[self._numbers[name]] = 0.0

    def _now(self) -> float:
        """The yard's time between the steps too, in seconds since its start."""
        return self._clock.seconds() - self._origin

    def _schedule(self) -> None:
        self._pending = self._clock.callLater(max(0.0, (self.crowd.ticks + 1) * TICK - self._now()), self._turn)

    def _turn(self) -> None:
        late = self._now() - (self.crowd.ticks + 1) * TICK
        if late > MAX_LATE_S:
            # The time that a machine was too slow for is not made up for, and what was ordered before it is over.
            self._origin += late
            self._reception.halt()
        self._tick()
        self._schedule()

    def _tick(self) -> None:
        began = self._stopwatch()
        self._reception.expire(self.crowd.t)
        self.crowd.wish[len(self.names) :] = self._controller(self._others)
        self.crowd.step()
        self._feelings.sample()
        moved = self._stopwatch()
        for number, name in enumerate(self.names):
            if name in self._reception.holders:
                values = self._feelings.values(number)
                self._reception.tell(name, self.crowd.t, values, sampled(values), partial(self._eyes.jpeg, number))
        self._reception.drop_silent()
        self.moving += moved - began
        self.telling += self._stopwatch() - moved
