"""Test cases with several simulated nodes."""

from __future__ import annotations

from typing import TypeVar

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.network.switchboard import CALM, Switchboard, Weather
from sim.team.world import JOINING, TEAM, Fleet, SwarmFleet, World

__all__ = ["TEAM", "Fleet", "FleetCase", "SwarmFleet", "World"]

T = TypeVar("T")


class FleetCase(SynchronousTestCase):
    """A test with simulated nodes; at its end no timers may be left."""

    worlds: list[Fleet | SwarmFleet]

    def setUp(self) -> None:
        self.worlds = []

    def fleet(self, n: int, seed: int = 1, weather: Weather = CALM) -> Fleet:
        """Return a simulated team that is stopped at the end of the test."""
        fleet = Fleet(n, seed, weather)
        self.worlds.append(fleet)
        return fleet

    def swarm(self, n: int, seed: int = 1, weather: Weather = CALM, pause: float = JOINING) -> SwarmFleet:
        """Return a simulated team of swarm nodes that is stopped at the end of the test."""
        fleet = SwarmFleet(n, seed, weather, pause)
        self.worlds.append(fleet)
        return fleet

    def tearDown(self) -> None:
        for world in self.worlds:
            world.stop()
            weather_only = [call for call in world.clock.getDelayedCalls() if not _is_delivery(call)]
            self.assertEqual(weather_only, [], "a node left a timer behind")

    def done(self, world: World, work: Deferred[T], within: float = 5.0) -> T:
        """Return the result of ``work`` after ``within`` seconds of virtual time."""
        world.run(within)
        return self.successResultOf(work)


def _is_delivery(call: object) -> bool:
    """Return whether a delayed call is a datagram in transit, which cannot be cancelled."""
    return getattr(getattr(call, "_function", None), "__self__", None).__class__ is Switchboard
