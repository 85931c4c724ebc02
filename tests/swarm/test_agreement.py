"""Tests of whole teams in memory with strategies that use battery levels, votes and numbers."""

from __future__ import annotations

from typing import Any

from middleware.diagnostics.explanation import explain_decisions, format_explanation
from middleware.tasks.task import Member, Task
from swarmnode.simulated_team import SimulatedTeam
from tests.swarm.case import TeamCase
from tests.swarm.facing import Facing


class AgreementTests(TeamCase):
    def setUp(self) -> None:
        self.use_facing()
        self.patch(Facing, "contexts", [])
        self.team = self.start_team(5)
        self.team.clock.advance(0.5)
        self.members_seen: dict[str, Member] = {}

    def look(self, team: SimulatedTeam) -> None:
        """Record the latest report of each device."""
        self.members_seen.update({member.name: member for member in self.members(team, "t1")})

    def run_task(self, strategy: str) -> dict[str, Any]:
        """Run a task to its end and return it as the page shows it."""
        task = Task("t1", "facing", "Face it", {"compass": {}}, {"towards": 2.0}, strategy, waiting_period=2.0)
        self.submit(self.team, task)
        self.until(self.team, lambda: self.task(self.team)["status"] == "COMPLETED", 12.0)
        return self.task(self.team)

    def why(self) -> str:
        """Return the output of ``swarm why`` for the task."""
        return format_explanation(explain_decisions(self.verdicts(self.team, "t1")))

    def test_charged_dog_goes(self) -> None:
        """With ``capability_cost`` the nearest dog does not act if its battery is low; all explanations agree."""
        self.team.simulator._sensors["dog2"]._power = 0.1
        shown = self.run_task("capability_cost")
        self.assertNotEqual(shown["result"]["by"], "dog2")
        reasons = self.why()
        self.assertIn("3 of 3 agree", reasons)
        self.assertIn("battery 10%", reasons)
        self.assertNotIn("differs", reasons)

    def test_nearest_does_not_mind_the_charge(self) -> None:
        """With ``nearest`` the same dog acts, and the explanation does not mention the battery."""
        self.team.simulator._sensors["dog2"]._power = 0.1
        self.assertEqual(self.run_task("nearest")["result"]["by"], "dog2")
        self.assertNotIn("battery", self.why())
        self.assertEqual({member.battery for member in self.members_seen.values()}, {1.0})

    def test_vote_reaches_who_acts(self) -> None:
        """The option for which two of three dogs vote wins, and one of these two dogs acts.

        All explanations agree.
        """
        shown = self.run_task("weighted_vote")
        self.assertIn(shown["result"]["by"], ("dog1", "dog2"))
        self.assertEqual({context.choice for context in Facing.contexts}, {"north"})
        reasons = self.why()
        self.assertIn("  agreed on north\n", reasons)
        self.assertIn("3 of 3 agree", reasons)
        self.assertEqual(shown["why"][0]["agreed"], "north")

    def test_mean_reaches_who_acts(self) -> None:
        """All dogs agree on the exact mean of their three values, and the assigned agent receives this mean."""
        self.run_task("average")
        offered = [member.value[0] for member in self.members_seen.values()]
        self.assertEqual((len(offered), len(set(offered))), (3, 3))
        self.assertEqual({len(context.value) for context in Facing.contexts}, {1})
        for context in Facing.contexts:
            self.assertAlmostEqual(context.value[0], sum(offered) / 3)
        self.assertNotIn("differs", self.why())
