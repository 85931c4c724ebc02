"""Tests of the emergency stop of a whole team in memory, and of its release."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred

from middleware.stop.stop_state import NO_ANSWER, SLOT, STOPS_KEY
from tests.swarm.case import TeamCase
from webnode.stop_control import StopControl

BRAKING = 0.2
"""The time in seconds from the stop until all three dogs stand still."""


class StopTests(TeamCase):
    def setUp(self) -> None:
        self.team = self.start_team(5)
        self.halts = StopControl(self.team.client)

    def node(self, name: str) -> Any:
        """Return the node of a device."""
        return self.team.services[name].assembly.node

    def moved_in(self, seconds: float) -> set[str]:
        """Return the dogs that move during the next seconds."""
        moved: set[str] = set()
        for _ in range(round(seconds / 0.05)):
            self.team.clock.advance(0.05)
            moved.update(self.moving(self.team))
        return moved

    def outcomes(self, asked: Deferred[dict[str, str]]) -> dict[str, str]:
        """Return the outcome for each device, by the device's name."""
        return {
            name: expected for uuid, expected in self.successResultOf(asked).items() if (name := self.name_of(uuid))
        }

    def name_of(self, uuid: str) -> str:
        """Return the name of a node."""
        return next(name for name, service in self.team.services.items() if service.assembly.node.uuid == uuid)

    def until_executing(self) -> str:
        """Run the demonstration until a dog acts; return the name of that dog."""
        self.team.run_demo()
        self.until(self.team, lambda: bool(self.executing(self.team) and self.moving(self.team)))
        return self.executing(self.team)[0]

    def test_all_stand_at_once_and_go_on(self) -> None:
        """After a stop all dogs stop within 0.2 s and do not move for 10 s.

        After the release the same dog continues.
        """
        acting = self.until_executing()
        token = self.team.services[acting].assembly.agent.engagement.lease_client.token  # type: ignore[union-attr]
        asked = self.halts.stop("ann")
        self.team.clock.advance(BRAKING)
        self.assertEqual(self.moving(self.team), [])
        expected = {"vaio": "has no robot", "dog1": "stands", "dog2": "stands", "dog3": "stands"}
        self.assertEqual(self.outcomes(asked), expected)
        self.assertEqual(self.moved_in(10.0), set())
        self.assertTrue(self.team.state()["halted"])
        self.assertEqual(self.executing(self.team), [acting])
        agent: Any = self.team.services[acting].assembly.agent
        self.assertEqual(agent.engagement.lease_client.lease.token, token)
        self.halts.release("ann")
        self.assertIn(acting, self.moved_in(1.0))
        self.team.clock.advance(30.0)
        state = self.team.state()
        self.assertFalse(state["halted"])
        self.assertEqual((state["tasks"][0]["status"], state["tasks"][0]["result"]["by"]), ("COMPLETED", acting))

    def test_nobody_takes_over(self) -> None:
        """If the acting dog fails during a stop, no dog moves before the release; then another dog takes over."""
        acting = self.until_executing()
        self.halts.stop("ann")
        self.team.clock.advance(1.0)
        self.team.kill(acting)
        self.assertEqual(self.moved_in(8.0), set())
        self.halts.release("ann")
        self.assertTrue(self.moved_in(5.0) - {acting})

    def test_who_comes_later_stands(self) -> None:
        """A dog that joins a stopped team with an open task does not move before the release."""
        team = self.start_team(6, ("dog1", "dog2"))
        halts = StopControl(team.client)
        halts.stop("ann")
        team.clock.advance(0.5)
        team.run_demo()
        team.add_node("dog3")
        moved: set[str] = set()
        for _ in range(100):
            team.clock.advance(0.05)
            moved.update(self.moving(team))
        self.assertEqual(moved, set())
        self.assertTrue(team.services["dog3"].assembly.node.stop_state.is_stopped)
        halts.release("ann")
        team.clock.advance(2.0)
        self.assertTrue(self.moving(team))

    def test_who_cannot_be_told_reads_it(self) -> None:
        """An unreachable dog is reported as unreachable.

        The dog stops as soon as it can communicate with the other devices again.
        """
        self.team.run_demo()
        self.team.clock.advance(1.0)
        self.team.block_datagrams("dog2")
        asked = self.halts.stop("ann")
        self.team.clock.advance(2.0)
        self.assertEqual(self.outcomes(asked)["dog2"], NO_ANSWER)
        self.team.switchboard.heal()
        self.team.clock.advance(15.0)
        self.assertTrue(self.node("dog2").stop_state.is_stopped)
        self.assertEqual(self.moved_in(3.0), set())

    def test_a_release_ends_the_stops_that_it_names(self) -> None:
        """A release ends only the stops that it lists: a later stop by a different operator remains in force."""
        self.halts.stop("ann")
        self.team.clock.advance(0.5)
        shown = [stop["id"] for stop in self.team.state()["halt"]["stops"]]
        self.halts.stop("bob")
        self.halts.release("ann", shown)
        self.team.clock.advance(1.0)
        self.assertEqual([stop["by"] for stop in self.team.state()["halt"]["stops"]], ["bob"])
        self.assertTrue(self.team.state()["halted"])
        self.halts.release("ann")
        self.team.clock.advance(1.0)
        self.assertFalse(self.team.state()["halted"])

    def test_nobody_waits_for_who_is_silent(self) -> None:
        """A silent device does not delay the stop of the other devices.

        The page lists the silent device, and does not show the team as stopped.
        """
        acting = self.until_executing()
        silent = "dog2" if acting == "dog1" else "dog1"
        self.team.block_datagrams(silent)
        self.halts.stop("ann")
        self.team.clock.advance(BRAKING)
        self.assertNotIn(acting, self.moving(self.team))
        self.assertTrue(self.node(acting).stop_state.is_stopped)
        self.team.clock.advance(3.0)
        state = self.team.state()
        self.assertEqual((state["halted"], [other["name"] for other in state["halt"]["others"]]), (False, [silent]))

    def test_a_release_that_was_not_heard_shows(self) -> None:
        """A robot that misses the release is shown as stopped; it continues when it receives the release."""
        self.halts.stop("ann")
        self.team.clock.advance(1.0)
        self.assertTrue(self.team.state()["halted"])
        self.team.block_datagrams("dog2")
        self.halts.release("ann")
        self.team.clock.advance(2.0)
        self.assertEqual(self.team.state()["halt"]["standing"], ["dog2"])
        self.team.switchboard.heal()
        self.team.clock.advance(15.0)
        self.assertFalse(self.node("dog2").stop_state.is_motion_forbidden)
        self.assertEqual(self.team.state()["halt"]["stops"], [])

    def test_a_record_that_is_no_statement_is_nothing(self) -> None:
        """A record in the stop's slot that is not a valid statement has no effect."""
        for value in (b"", b"\xc1", b"\x93\x01\x02\x03", b"\x93\xff\xc3\xa1x", b"\x80"):
            self.node("vaio").entangled.put(STOPS_KEY, SLOT, value, "team")
            self.team.clock.advance(0.5)
            self.assertFalse(self.team.state()["halted"])
        self.assertFalse(self.node("dog1").stop_state.is_motion_forbidden)

    def test_the_device_says_who(self) -> None:
        """The log of each device contains the operator that stopped it and the operator that released it."""
        self.halts.stop("ann")
        self.team.clock.advance(0.5)
        self.halts.release("bob")
        self.team.clock.advance(0.5)
        row = next(row for row in self.team.state()["devices"] if row["name"] == "dog1")
        self.assertEqual([text for _, text in row["messages"]][-2:], ["stopped by ann", "released by bob"])
