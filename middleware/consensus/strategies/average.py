"""Strategy ``average``: all agents agree on the weighted mean of their numbers or positions."""

from __future__ import annotations

import math
from collections.abc import Sequence

from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Consensus, Report, build_consensus, refusal, standing

Point = tuple[float, ...]


class Average(Nearest):
    """The weighted mean of all reported values.

    The agent with the lowest cost acts. The only action is to publish the value, which is identical at all nodes.
    """

    name = "average"
    version = "1"
    reads = ("value", "weight")

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """Return the decision; its ``value`` is () if no agent reports a value."""
        counted = self.merge(contacts, ())
        if not counted:
            return Consensus(None, strategy=self.name, reason="no agent reports a value")
        order = sorted(counted, key=lambda r: (r.cost, r.agent))
        value = self.combine_points([r.value for r in counted], [r.weight for r in counted])
        return build_consensus(self.name, order, counted, f"{self.name} of {len(order)}", value=value)

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """Return the report with the newest value of each agent, for the task with the lowest id.

        If the values have different numbers of coordinates, only values with the lowest number of coordinates are used.
        """
        valued = [r for r in (*a, *b) if not refusal(r) and r.value and r.weight > 0.0]
        first = min(((-r.epoch, r.task, len(r.value)) for r in valued), default=None)
        alike = (r for r in valued if (-r.epoch, r.task, len(r.value)) == first)
        return standing(alike, lambda report: -report.sequence)

    def combine_points(self, points: Sequence[Point], weights: Sequence[float]) -> Point:
        """Return the combined point of all agents; the order of ``points`` makes no difference."""
        return mean(points, weights)


def mean(points: Sequence[Point], weights: Sequence[float]) -> Point:
    """Return the weighted mean, clamped to the bounding box of the points; their order makes no difference."""
    total = math.fsum(weights)
    found = []
    for numbers in zip(*points, strict=True):
        middle = math.fsum(n * w for n, w in zip(numbers, weights, strict=True)) / total
        found.append(min(max(middle, min(numbers)), max(numbers)))
    return tuple(found)
