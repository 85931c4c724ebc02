"""Workload that checks the minimum: living nodes have joined the network and have contacts."""

from __future__ import annotations

from dataclasses import dataclass

from sim.team.figure import Figure
from sim.team.team import Team
from sim.team.workload import Kind, Workload


@dataclass(frozen=True)
class StandingSettings:
    """``[load.standing]``: no settings."""


class Standing(Workload):
    """A workload that observes the team and sends nothing."""

    def __init__(self, team: Team, settings: StandingSettings) -> None:
        self._team = team

    def verdict(self) -> list[str]:
        """Return the nodes that have joined but have no contacts."""
        team = self._team
        lonely = [p for p in sorted(team.inside()) if len(team.living) > 1 and not team.entangled(p).overlay.contacts()]
        return [f"standing: node {place} has no contacts" for place in lonely]

    def figures(self) -> list[Figure]:
        """Return the numbers of nodes, and the traffic."""
        team = self._team
        sent = sum(team.traffic(place).sent_bytes for place in team.places)
        seconds = team.clock.seconds() * max(1, len(team.living))
        return [
            Figure("nodes", len(team.living)),
            Figure("nodes inside", len(team.inside())),
            Figure("sent per node", sent / seconds if seconds else 0.0, "B/s"),
        ]


STANDING = Kind(StandingSettings, Standing)
