"""Tests of the page and the shell with a directory that is split by id prefix: both list all devices."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from twisted.internet.defer import Deferred

from middleware.diagnostics.node_diagnostics import describe_store
from middleware.frontend.client import TeamClient
from swarmnode.control_client import ControlClient
from swarmnode.team.verb import TeamVerbs
from tests.fleet import FleetCase, SwarmTeam
from tests.swarmnode.shell import runtime_folder
from webnode.state import DepartedDevices
from webnode.state_builder import build_state
from webnode.team_control import TeamControl

COUNT = 9


class NoVerbs:
    """A stub of the verbs for tests that use none."""

    def run(self, name: object, arguments: object, tell: Callable[[Any], None]) -> Deferred[Any]:
        """Fail the test."""
        raise AssertionError(name)


class SplitTests(FleetCase):
    def apart(self) -> SwarmTeam:
        """Return nodes with a split directory, as in a large team."""
        fleet = self.swarm(COUNT)
        for node in fleet.nodes:
            node.directory.depth = 3
            node.presence.change(depth=3)
        fleet.run(2.0)
        return fleet

    def test_page(self) -> None:
        """The page of a web node shows every device of a split directory."""
        fleet = self.apart()
        control = TeamControl(TeamClient(fleet.nodes[2]), {}, "")
        fleet.run(3.0)
        state = build_state(control.read, DepartedDevices(), "dog2", 0.0)
        self.assertEqual([device["name"] for device in state["devices"]], [f"dog{n}" for n in range(COUNT)])

    def test_shell(self) -> None:
        """``swarm links``, ``chaos`` and ``deploy`` find every device, in the order in which the devices joined."""
        fleet = self.apart()
        runtime_folder(self, "dog2")
        verbs = TeamVerbs(NoVerbs(), fleet.nodes[2])

        def ask(path: Path, request: dict[str, Any]) -> Iterator[dict[str, Any]]:
            asked = verbs.run(request["verb"], request["with"], lambda event: None)
            yield {"answer": self.done(fleet, asked, 1.0)}

        found = ControlClient("dog2", ask).list_devices()
        self.assertEqual([device.name for device, _ in found], [f"dog{n}" for n in range(COUNT)])
        self.assertEqual(found[4][1].owner, fleet.nodes[4].entangled.identity.public)

    def test_what_a_node_holds(self) -> None:
        """The inventory of a node counts the records of a split directory as devices."""
        fleet = self.apart()
        self.assertEqual({kind for node in fleet.nodes for kind in describe_store(node)["kinds"]}, {"devices"})
