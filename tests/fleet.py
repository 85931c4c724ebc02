"""Test cases with several simulated nodes."""

from __future__ import annotations

from typing import TypeVar

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.network.switchboard import PERFECT, LinkConditions, Switchboard
from sim.team.simulation import JOIN_S, TEAM_KEY, EntangledTeam, Simulation, SwarmTeam

__all__ = ["TEAM_KEY", "EntangledTeam", "FleetCase", "SwarmTeam", "Simulation"]

T = TypeVar("T")


class FleetCase(SynchronousTestCase):
    """A test with simulated nodes; no timer may be left at the end of the test."""

    worlds: list[EntangledTeam | SwarmTeam]

    def setUp(self) -> None:
        self.worlds = []

    def fleet(self, n: int, seed: int = 1, weather: LinkConditions = PERFECT) -> EntangledTeam:
        """Return a simulated team that is stopped at the end of the test."""
        fleet = EntangledTeam(n, seed, weather)
        self.worlds.append(fleet)
        return fleet

    def swarm(self, n: int, seed: int = 1, weather: LinkConditions = PERFECT, pause: float = JOIN_S) -> SwarmTeam:
        """Return a simulated team of swarm nodes that is stopped at the end of the test."""
        fleet = SwarmTeam(n, seed, weather, pause)
        self.worlds.append(fleet)
        return fleet

    def tearDown(self) -> None:
        for world in self.worlds:
            world.stop()
            weather_only = [call for call in world.clock.getDelayedCalls() if not _is_delivery(call)]
            self.assertEqual(weather_only, [], "a node left a timer behind")

    def done(self, world: Simulation, work: Deferred[T], within: float = 5.0) -> T:
        """Run for ``within`` seconds of virtual time; return the result of ``work``."""
        world.run(within)
        return self.successResultOf(work)


def _is_delivery(call: object) -> bool:
    """Return whether a delayed call is a datagram in transit, which cannot be cancelled."""
    return getattr(getattr(call, "_function", None), "__self__", None).__class__ is Switchboard
