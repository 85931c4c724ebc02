"""A strategy in ten lines: of the robots at about the same distance, select the robot with the fullest battery."""

from __future__ import annotations

from middleware.consensus.strategies.capability_cost import CapabilityCost
from middleware.consensus.strategy import Report


class Spare(CapabilityCost):
    """Compare distances in steps of ten metres; within one step the battery decides, and then the agent's id."""

    name = "spare"
    version = "1"

    def weigh(self, report: Report) -> float:
        """Return the number of whole ten metres of the cost, plus half of the missing charge."""
        return report.cost // 10.0 + (1.0 - report.battery) / 2.0
