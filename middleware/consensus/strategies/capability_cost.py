"""Strategy ``capability_cost``: among devices of different kinds, the capable device with the lowest cost acts.

A device that does not meet a requirement lists the requirement in ``Report.unmet`` and is never assigned (thesis,
Assumption 5 and Algorithm 4.4).  The other devices are compared by travel time, battery and number of tasks.
"""

from __future__ import annotations

from collections.abc import Sequence

from middleware.consensus.strategies.nearest import Nearest, select_best
from middleware.consensus.strategy import Consensus, Report, build_consensus

BATTERY_S = 30.0
"""Seconds that an empty battery adds to the cost."""
LOAD_S = 20.0
"""Seconds that each task that the agent already has adds to the cost."""


class CapabilityCost(Nearest):
    """The lowest sum of ``cost`` in seconds, battery penalty and load penalty wins; ties are broken by uuid."""

    name = "capability_cost"
    version = "1"
    reads = ("battery", "load")

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """Return the decision; if no report is valid (``strategy.refusal``), no agent is assigned."""
        order = select_best(contacts, self.weigh)
        if not order:
            return Consensus(None, strategy=self.name, reason="no device meets the requirements of the task")
        first = order[0]
        reason = f"{first.cost:.1f} s away, battery {first.battery:.0%}, {first.load:g} other tasks"
        return build_consensus(self.name, order, order, reason)

    def weigh(self, report: Report) -> float:
        """Return the total cost of a report in seconds: travel time, battery penalty and load penalty."""
        return report.cost + BATTERY_S * (1.0 - report.battery) + LOAD_S * report.load
