"""Tests of the benchmark of the strategies at its smallest size."""

from __future__ import annotations

import json

from twisted.trial.unittest import SynchronousTestCase

from benchmarks.consensus.__main__ import measure_size
from benchmarks.consensus.cbba_run import run_cbba
from benchmarks.consensus.decider import DECIDERS
from benchmarks.consensus.mission import Mission
from benchmarks.consensus.oracle import solve_assignment
from benchmarks.consensus.plot import AFTER, BAR, CALM, draw_svg


class BenchConsensusTests(SynchronousTestCase):
    def test_missions_are_seeded(self) -> None:
        """The same seed gives the same mission, with and without failing agents."""
        one, again, other = Mission(20, 20, 1), Mission(20, 20, 1), Mission(20, 20, 2)
        self.assertEqual((one.costs, one.items), (again.costs, again.items))
        self.assertNotEqual(one.costs, other.costs)
        after = Mission(20, 20, 1, 10)
        self.assertEqual((after.agent_positions, len(after.alive)), (one.agent_positions, 18))
        self.assertEqual(after.capacity, 2)

    def test_nobody_beats_the_oracle(self) -> None:
        """No strategy costs less than the optimum, and ``group_optimal`` costs the optimum.

        Each strategy assigns every task.
        """
        mission = Mission(8, 8, 3)
        least = solve_assignment(mission)[0]
        for name, decide in DECIDERS.items():
            owners = decide(mission, mission.make_reports(mission.alive, 8))
            self.assertEqual(set(owners), set(mission.task_positions), name)
            cost = sum(mission.costs[agent][task] for task, agent in owners.items())
            self.assertGreaterEqual(cost, least, name)
            if name == "group_optimal":
                self.assertEqual(cost, least)

    def test_talk(self) -> None:
        """The bidders agree on one owner for each task, even with message loss."""
        for loss in (0.0, 0.3):
            found = run_cbba(Mission(12, 12, 1), loss=loss)
            self.assertEqual(sorted(map(len, found.owners.values())), [1] * 12)
            self.assertGreater(found.messages, 1.0)

    def test_rows(self) -> None:
        """Each strategy has one row per size.

        No cost ratio is below 1, and the ratio of ``group_optimal`` is exactly 1.
        """
        rows = {row["strategy"]: row for row in measure_size(10, range(1, 4))}
        self.assertEqual(list(rows), list(DECIDERS))
        self.assertEqual({row["missions"] for row in rows.values()}, {3})
        self.assertGreaterEqual(min(min(row["ratio"], row["ratio_failed"]) for row in rows.values()), 1.0)
        self.assertEqual((rows["group_optimal"]["ratio"], rows["group_optimal"]["ratio_failed"]), (1.0, 1.0))
        self.assertLess(rows["cbba, then meetings"]["ratio"], rows["cbba"]["ratio"])
        self.assertEqual((rows["cbba"]["two_owners"], rows["cbba"]["unlike_greedy"]), (0, 0))
        self.assertGreater(rows["cbba"]["messages"], rows["cbba + exchange"]["messages"])

    def test_plot(self) -> None:
        """The plot is drawn from JSON rows. The length of each bar is proportional to the cost above the optimum."""
        row = {"agents": 3, "strategy": "a < b", "ratio": 1.1, "ratio_failed": 1.2}
        picture = draw_svg(json.loads(json.dumps([row])))
        self.assertIn("a &lt; b", picture)
        self.assertIn(f'width="{BAR / 2:.1f}" height="7" fill="{CALM}"', picture)
        self.assertIn(f'width="{BAR:.1f}" height="7" fill="{AFTER}"', picture)
