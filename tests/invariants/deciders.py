"""Check that agents that receive the same reports reach the same decision, in any order of the reports.

Invariants (in brackets: the invariants of a whole team that follow from them):

C1: agents with the same reports in any order assign the same agent (E7, S3).

C2: an invalid report is never assigned, and does not change the assignment (S4).

C3: among 300 agents the agent with the lowest cost is found, as among three.

C4: if bidders stop by the stopping rule, no task has two owners.
"""

from __future__ import annotations

import math
import random

from benchmarks.consensus import bidder
from benchmarks.consensus.mission import Mission
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Report
from sim.team.schedule import Schedule
from sim.team.workload import Workload

LINE = 12


class Deciders(Workload):
    """Lets random teams decide, and bidders in a line bid. The faults of the schedule have no effect on it."""

    def __init__(self, schedule: Schedule) -> None:
        self._rng = random.Random(f"deciders/{schedule.seed}")
        self._found: list[str] = []

    def step(self) -> None:
        """Let a small team decide on random reports."""
        contacts = [Report(f"agent-{n:03d}", self._rng.choice([1.0, 1.0, 2.0])) for n in range(4)]
        views = [self._rng.sample(contacts, len(contacts)) for _ in contacts]
        assigned = sorted({str(Nearest().find(view).assigned_agent) for view in views})
        if len(assigned) > 1:
            self._found.append(f"C1: {' and '.join(assigned)} are assigned from equal reports")
        bad = Report("agent-bad", self._rng.choice([math.nan, math.inf, -math.inf, -1.0]))
        view = self._rng.sample([*contacts, bad], len(contacts) + 1)
        if str(Nearest().find(view).assigned_agent) not in assigned:
            self._found.append(f"C2: a cost of {bad.cost} gets {Nearest().find(view).assigned_agent} assigned")

    def make_final_requests(self) -> None:
        """Let a large team decide once, and a line of bidders bid until all have stopped."""
        far = [Report(f"agent-{n:03d}", 300.0 - n) for n in range(300)]
        found = Nearest().find(far).assigned_agent
        if found != "agent-299":
            self._found.append(f"C3: of 300 agents {found} is assigned, not agent-299")
        mission = Mission(LINE, LINE, self._rng.randrange(10**6))
        self._found += [f"C4: {' and '.join(o)} own {t}" for t, o in stopped(mission).items() if len(o) > 1]

    def find_violations(self) -> list[str]:
        """Return the violations found so far."""
        return self._found


def stopped(mission: Mission) -> dict[str, list[str]]:
    """Return the owners of each task after bidders in a line (each talks to its neighbours) have all stopped."""
    names = mission.alive
    near = {a: [names[m] for m in (n - 1, n + 1) if 0 <= m < len(names)] for n, a in enumerate(names)}
    bidders = {}
    for name in names:
        worth = {task: 5000.0 - cost * 1e-6 for task, cost in mission.costs[name].items()}
        score: bidder.Score = lambda bundle, task, worth=worth: worth[task]  # type: ignore[misc]  # noqa: E731
        bidders[name] = bidder.Bidder(name, mission.task_positions, score, 1, near[name])
    quiet = dict.fromkeys(names, 0)
    talking, rounds = list(names), 0
    while talking:
        rounds += 1
        messages = [(a, to, news) for a in talking for to, news in bidders[a].drain().items()]
        for name in talking:
            before = bidders[name].bundle
            for a, to, news in messages:
                if to == name:
                    bidders[name].receive(a, news)
            is_same = bidders[name].is_quiet and bidders[name].bundle == before
            quiet[name] = quiet[name] + 1 if is_same else 0
        talking = [n for n in talking if not bidder.is_final(rounds, quiet[n], len(mission.task_positions), len(names))]
    owners: dict[str, list[str]] = {}
    for name, one in bidders.items():
        for task in one.bundle:
            owners.setdefault(task, []).append(name)
    return owners
