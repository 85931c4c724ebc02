"""Define workloads: the clients of a simulated team, their checks, and their figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from sim.team.metric import Metric
from sim.team.team import Team


class Workload:
    """A workload, created before the first node joins; ``Simulation.watch_lives`` reports starts and ends of nodes.

    The workload records requests and answers in the history, for the checker.
    """

    def step(self) -> None:
        """Make the next requests; called repeatedly while faults occur."""

    def make_final_requests(self) -> None:
        """Make the final requests, after the faults and the repair interval; answers are awaited for 10 s."""

    def find_violations(self) -> list[str]:
        """Record the final state; return the violations that only this workload can detect, one line each."""
        return []

    def collect_metrics(self) -> list[Metric]:
        """Return the figures so far; called repeatedly during the run, and at its end.

        The result always contains all names, so that targets can be validated; a value is None until it is measured.
        """
        return []


@dataclass(frozen=True)
class WorkloadKind:
    """A kind of workload: ``settings`` is a frozen dataclass with constrained fields (``formats.convert``).

    ``make(team, settings)`` creates a workload of this kind.
    """

    settings: type[Any]
    make: Callable[[Team, Any], Workload]


WorkloadKinds = Mapping[str, WorkloadKind]
