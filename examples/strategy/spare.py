"""A strategy in ten lines: of all robots that are near enough, select the one with the fullest battery."""

from __future__ import annotations

from middleware.consensus.strategies.capability_cost import CapabilityCost
from middleware.consensus.strategy import Report


class Spare(CapabilityCost):
    """Distances that differ by less than ten metres count as equal; then the battery decides, and then the id."""

    name = "spare"
    version = "1"

    def weigh(self, report: Report) -> float:
        """Return tens of metres plus half of the missing charge."""
        return report.cost // 10.0 + (1.0 - report.battery) / 2.0
