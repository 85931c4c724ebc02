"""CrowdYard: a crowd whose first robots are driven over the yard's own wire; a controller has the others."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from random import Random

from twisted.internet.interfaces import IReactorTime

from sim.robots.crowd.body import CrowdBody
from sim.robots.crowd.controller import Controller, Senses, wander
from sim.robots.crowd.crowd import Crowd
from sim.robots.crowd.eye import Eyes
from sim.robots.crowd.feeling import Feelings, sampled
from sim.robots.crowd.ground import Ground
from sim.robots.paced import PacedYard
from sim.robots.scene import SceneError

SPARE = 8
"""Connections beside one for each robot that can be driven."""


class CrowdYard(PacedYard):
    """A yard for many, on ``ground``.

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
        self._controller = controller
        self._others = Senses(self.crowd, driven)
        self._feelings = Feelings(rng.getrandbits(64), self.crowd, self.names)
        self._eyes = Eyes(Random(rng.getrandbits(64)), self.crowd)
        self._numbers = {name: number for number, name in enumerate(self.names)}
        self._stopwatch = stopwatch
        super().__init__(clock, self.names, self, driven + SPARE)

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

    def _play(self, late: float) -> int:
        """One tick, however late: the next one, with all that drivers say till then, comes at once."""
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
        return 1
