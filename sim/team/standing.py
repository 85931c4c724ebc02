"""Standing: whether those who live are in the network and know others; the least that any run can be held to."""

from __future__ import annotations

from dataclasses import dataclass

from sim.team.figure import Figure
from sim.team.team import Team
from sim.team.workload import Kind, Workload


@dataclass(frozen=True)
class StandingSettings:
    """``[load.standing]``: nothing can be set."""


class Standing(Workload):
    """Looks at the team; it asks nobody anything."""

    def __init__(self, team: Team, settings: StandingSettings) -> None:
        self._team = team

    def verdict(self) -> list[str]:
        """Who is in the network and knows nobody."""
        team = self._team
        lonely = [p for p in sorted(team.inside()) if len(team.living) > 1 and not team.entangled(p).overlay.contacts()]
        return [f"standing: node {place} knows nobody" for place in lonely]

    def figures(self) -> list[Figure]:
        """How many there are, and what they sent."""
        team = self._team
        sent = sum(team.traffic(place).sent_bytes for place in team.places)
        seconds = team.clock.seconds() * max(1, len(team.living))
        return [
            Figure("nodes", len(team.living)),
            Figure("nodes inside", len(team.inside())),
            Figure("sent per node", sent / seconds if seconds else 0.0, "B/s"),
        ]


STANDING = Kind(StandingSettings, Standing)
