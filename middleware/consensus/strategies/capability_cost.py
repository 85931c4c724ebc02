"""Capability and cost: among devices of different kinds, the one that can do it and to which it costs least.

Who does not meet a requirement has it in ``Report.unmet`` and never wins (Assumption 5 of the thesis; Algorithm 4.4).
The others are compared by the time to get there, the battery that is left and the tasks that they have already.
"""

from __future__ import annotations

from collections.abc import Sequence

from middleware.consensus.strategies.nearest import Nearest, best_of
from middleware.consensus.strategy import Consensus, Report, led_by

BATTERY_S = 30.0
"""An empty battery weighs as much as so many seconds of way."""
LOAD_S = 20.0
"""Each task that an agent has already weighs as much as so many seconds of way."""


class CapabilityCost(Nearest):
    """``cost`` in seconds, plus what a low battery and other tasks weigh; the least wins, ties go by the id."""

    name = "capability_cost"
    version = "1"
    reads = ("battery", "load")

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """The consensus point; None is assigned where nobody can, and ``strategy.refusal`` says why for each."""
        order = best_of(contacts, self.weigh)
        if not order:
            return Consensus(None, strategy=self.name, reason="no device can do it")
        first = order[0]
        reason = f"{first.cost:.1f} s away, battery {first.battery:.0%}, {first.load:g} other tasks"
        return led_by(self.name, order, order, reason)

    def weigh(self, report: Report) -> float:
        """What a report weighs, in seconds: it rises with way and load, and falls with the battery."""
        return report.cost + BATTERY_S * (1.0 - report.battery) + LOAD_S * report.load
