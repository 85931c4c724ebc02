"""Tests of the configurations of the demonstration in several network namespaces; no namespace is created."""

from __future__ import annotations

import tomllib
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from middleware.config.settings import Settings
from sim.demo.configuration import DOGS, JUDGE, Location
from sim.demo.robots import LOOPBACK, ROBOT_SETS
from sim.namespaces.demo import HOSTS, NODE_PORT, SITES, make_namespace_plan
from sim.namespaces.nat import NatKind


def places() -> dict[str, Location]:
    """Return an address for each process."""
    return {
        name: Location(f"198.19.1.{number}", "198.18.1.1", f"198.19.255.{number}", ("nsenter",))
        for number, name in enumerate(HOSTS, start=2)
    }


class NatDemoTests(SynchronousTestCase):
    def test_nobody_is_told_of_this_machine(self) -> None:
        """For each value of ROBOT all configurations are valid.

        Neither the configurations nor the emulators use the loopback address.
        """
        for cast in ROBOT_SETS:
            plan = make_namespace_plan(Path("/nowhere"), cast, places(), "over-there")
            for name, text in plan.make_configs().items():
                self.assertNotIn(LOOPBACK, text, (cast, name))
                settings = Settings.from_mapping(tomllib.loads(text), name)
                self.assertEqual(settings.node.host, plan.get_location(name).host)
            self.assertNotIn(LOOPBACK, plan.emulated_robots)

    def test_everybody_enters_by_the_router(self) -> None:
        """The dogs and the observer use the address of the bootstrap node that is valid in their own network."""
        plan = make_namespace_plan(Path("/nowhere"), "sim", places(), "over-there")
        for name in DOGS:
            self.assertIn(f'known_nodes = ["198.18.1.1:{NODE_PORT}"]', plan.make_configs()[name])
        self.assertEqual(plan.get_location(JUDGE).entry, "198.18.1.1")

    def test_two_dogs_are_behind_different_routers(self) -> None:
        """dog1 and dog2 are behind NATs of different kinds; dog3 is in the same network as the bootstrap node."""
        kinds = {f"{site.name}{number}": site.kind for site in SITES for number in range(1, site.hosts + 1)}
        self.assertEqual([kinds[HOSTS[name]] for name in DOGS[:2]], [NatKind.PORT, NatKind.SYM])
        self.assertEqual(HOSTS[DOGS[2]][:-1], HOSTS["vaio"][:-1])
