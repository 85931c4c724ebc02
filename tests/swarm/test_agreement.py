"""Whole teams in memory whose strategies go by more than a cost: charge, votes and numbers."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from agents.behaviour import KINDS
from middleware.consensus.verdict import verdict_of, verdicts_key
from middleware.diagnostics.explanation import as_text, explained
from middleware.tasks.task import Member, Task, group_key, member_of
from swarmnode.rehearsal import VirtualTeam
from tests.swarm.facing import Facing


class AgreementTests(SynchronousTestCase):
    def setUp(self) -> None:
        KINDS["facing"] = "tests.swarm.facing:Facing"
        self.addCleanup(KINDS.pop, "facing")
        self.patch(Facing, "contexts", [])
        self.team = VirtualTeam(5)
        self.addCleanup(self.team.stop)
        self.team.clock.advance(0.5)
        self.members: dict[str, Member] = {}

    def run_task(self, strategy: str, seconds: float = 12.0) -> dict[str, Any]:
        """Have a task done; how the page shows it at the end."""
        task = Task("t1", "facing", "Face it", {"compass": {}}, {"towards": 2.0}, strategy, waiting_period=2.0)
        Deferred.fromCoroutine(self.team.services["vaio"].assembly.node.submit(task))
        for _ in range(int(seconds / 0.2)):
            self.team.clock.advance(0.2)
            for record in self.team.desk.read(group_key("t1")):
                member = member_of(record)
                if member is not None:
                    self.members[member.name] = member
            shown = dict(next(iter(self.team.state()["tasks"]), {}))
            if shown.get("status") == "COMPLETED":
                return shown
        self.fail(f"not done within {seconds:g} s: {self.team.state()['tasks']}")

    def told(self) -> str:
        """What ``swarm why`` reads of the records."""
        records = self.team.desk.read(verdicts_key("t1"))
        return as_text(explained(v for record in records if (v := verdict_of(record)) is not None))

    def test_charged_dog_goes(self) -> None:
        """By ``capability_cost`` the nearest dog stays at rest where its battery is low, and all say why."""
        self.team.yard._senses["dog2"]._power = 0.1
        shown = self.run_task("capability_cost")
        self.assertNotEqual(shown["result"]["by"], "dog2")
        told = self.told()
        self.assertIn("3 of 3 agree", told)
        self.assertIn("battery 10%", told)
        self.assertNotIn("differs", told)

    def test_nearest_does_not_mind_the_charge(self) -> None:
        """By ``nearest`` the same dog goes, and nobody tells what it has left."""
        self.team.yard._senses["dog2"]._power = 0.1
        self.assertEqual(self.run_task("nearest")["result"]["by"], "dog2")
        self.assertNotIn("battery", self.told())
        self.assertEqual({member.battery for member in self.members.values()}, {1.0})

    def test_vote_reaches_who_acts(self) -> None:
        """The option of two of three dogs is agreed on, one of the two acts, knows it, and all say so."""
        shown = self.run_task("weighted_vote")
        self.assertIn(shown["result"]["by"], ("dog1", "dog2"))
        self.assertEqual({context.choice for context in Facing.contexts}, {"north"})
        told = self.told()
        self.assertIn("  agreed on north\n", told)
        self.assertIn("3 of 3 agree", told)
        self.assertEqual(shown["why"][0]["agreed"], "north")

    def test_mean_reaches_who_acts(self) -> None:
        """The mean of what the three dogs offer is agreed on in every digit, and whoever acts knows it."""
        self.run_task("average")
        offered = [member.value[0] for member in self.members.values()]
        self.assertEqual((len(offered), len(set(offered))), (3, 3))
        self.assertEqual({len(context.value) for context in Facing.contexts}, {1})
        for context in Facing.contexts:
            self.assertAlmostEqual(context.value[0], sum(offered) / 3)
        self.assertNotIn("differs", self.told())
