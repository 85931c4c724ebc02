"""Tests of what a running node says of itself and of its links."""

from __future__ import annotations

from twisted.internet.defer import Deferred

from middleware.entangled.control.health import ASKED, health, links
from middleware.entangled.network.switchboard import Weather
from tests.fleet import FleetCase


class HealthTests(FleetCase):
    def test_health(self) -> None:
        """A node says whom it knows, what it holds and may hold, and that nobody refused it."""
        fleet = self.fleet(3)
        said = health(fleet.nodes[1])
        self.assertEqual((said["contacts"], said["trouble"], said["refusals"]), (2, "", []))
        self.assertGreater(said["max_rows"], said["rows"])
        self.assertEqual(said["address"], str(fleet.address(1)))

    def test_links(self) -> None:
        """Each peer is timed by small questions; one that is gone answers none of them."""
        fleet = self.fleet(3, weather=Weather(delay_s=0.02))
        fleet.run(3.0)
        fleet.kill(2)
        asked = Deferred.fromCoroutine(links(fleet.nodes[0], fleet.clock))
        found = {each["id"]: each for each in self.done(fleet, asked, 30.0)}
        live, dead = (found[fleet.nodes[place].identity.node_id.hex()] for place in (1, 2))
        self.assertEqual(len(live["times"]), ASKED)
        self.assertEqual({round(seconds, 3) for seconds in live["times"]}, {0.04})
        self.assertEqual((set(dead["times"]), dead["relayed"]), ({None}, False))
