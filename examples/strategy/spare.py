"""Spare: of all that are near enough, the one with the fullest battery; a strategy of one's own in ten lines."""

from __future__ import annotations

from middleware.consensus.strategies.capability_cost import CapabilityCost
from middleware.consensus.strategy import Report


class Spare(CapabilityCost):
    """Ways that differ by less than ten metres count as equal; then the battery decides, and then the id."""

    name = "spare"
    version = "1"

    def weigh(self, report: Report) -> float:
        """Tens of metres, and then what is missing in the battery."""
        return report.cost // 10.0 + (1.0 - report.battery) / 2.0
