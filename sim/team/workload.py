"""Define workloads: the clients of a simulated team, their checks, and their figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from sim.team.metric import Metric
from sim.team.team import Team


class Workload:
    """A workload, created before the first node joins; ``Simulation.watch_lives`` tells it of births and deaths.

    It records requests and answers in the history, which the checker judges.
    """

    def step(self) -> None:
        """Act; called repeatedly while the faults last."""

    def make_final_requests(self) -> None:
        """Make the final requests, after the faults and the repair interval; 10 s remain for the answers."""

    def find_violations(self) -> list[str]:
        """Record the final state; returns the violations that only this workload can judge, one line each."""
        return []

    def collect_metrics(self) -> list[Metric]:
        """Return the figures so far; called repeatedly during the run, and at its end.

        All names are present from the beginning, so that targets can be validated; values are None until measured.
        """
        return []


@dataclass(frozen=True)
class WorkloadKind:
    """A kind of workload: ``settings`` is a frozen dataclass with constrained fields (``formats.convert``).

    ``make(team, settings)`` creates one.
    """

    settings: type[Any]
    make: Callable[[Team, Any], Workload]


WorkloadKinds = Mapping[str, WorkloadKind]
