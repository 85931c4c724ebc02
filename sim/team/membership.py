"""Workload: check only that joined nodes have contacts."""

from __future__ import annotations

from dataclasses import dataclass

from sim.team.metric import Metric
from sim.team.team import Team
from sim.team.workload import Workload, WorkloadKind


@dataclass(frozen=True)
class MembershipSettings:
    """``[load.standing]``: no settings."""


class Membership(Workload):
    """A workload that observes the team and sends nothing."""

    def __init__(self, team: Team, settings: MembershipSettings) -> None:
        self._team = team

    def find_violations(self) -> list[str]:
        """Return the nodes that have joined but have no contacts."""
        team = self._team
        lonely = [
            p
            for p in sorted(team.get_joined())
            if len(team.living) > 1 and not team.get_entangled(p).overlay.contacts()
        ]
        return [f"standing: node {place} has no contacts" for place in lonely]

    def collect_metrics(self) -> list[Metric]:
        """Return the numbers of nodes, and the traffic."""
        team = self._team
        sent = sum(team.traffic(place).sent_bytes for place in team.places)
        seconds = team.clock.seconds() * max(1, len(team.living))
        return [
            Metric("nodes", len(team.living)),
            Metric("nodes inside", len(team.get_joined())),
            Metric("sent per node", sent / seconds if seconds else 0.0, "B/s"),
        ]


MEMBERSHIP = WorkloadKind(MembershipSettings, Membership)
