"""Average: one number, or one place, out of those that all report; everybody ends with the identical one."""

from __future__ import annotations

import math
from collections.abc import Sequence

from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Consensus, Report, led_by, refusal, standing

Point = tuple[float, ...]


class Average(Nearest):
    """The mean of all values by weight.  The cheapest agent publishes it, and then it is what that record says."""

    name = "average"
    version = "1"
    reads = ("value", "weight")

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """The consensus point; its ``value`` is () where nobody reports one.  All values have equally many numbers."""
        counted = self.merge(contacts, ())
        if not counted:
            return Consensus(None, strategy=self.name, reason="nobody reports a value")
        order = sorted(counted, key=lambda r: (r.cost, r.agent))
        value = self.point([r.value for r in counted], [r.weight for r in counted])
        return led_by(self.name, order, counted, f"{self.name} of {len(order)}", value=value)

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """Everybody's newest value, about the first task by name; the fewest numbers that anybody gave say how many."""
        valued = [r for r in (*a, *b) if not refusal(r) and r.value and r.weight > 0.0]
        first = min(((-r.epoch, r.task, len(r.value)) for r in valued), default=None)
        alike = (r for r in valued if (-r.epoch, r.task, len(r.value)) == first)
        return standing(alike, lambda report: -report.sequence)

    def point(self, points: Sequence[Point], weights: Sequence[float]) -> Point:
        """What is agreed on, for points in any order."""
        return mean(points, weights)


def mean(points: Sequence[Point], weights: Sequence[float]) -> Point:
    """The mean by weight, rounded once, so that the order does not matter; never outside of the points."""
    total = math.fsum(weights)
    found = []
    for numbers in zip(*points, strict=True):
        middle = math.fsum(n * w for n, w in zip(numbers, weights, strict=True)) / total
        found.append(min(max(middle, min(numbers)), max(numbers)))
    return tuple(found)
