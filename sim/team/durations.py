"""Draw durations of sessions and absences from distributions with a given median.

When an observation starts, sessions are already in progress. Their durations have a different distribution, because
long sessions are more likely to be in progress (the inspection paradox). ``draw_remaining`` draws the remaining
durations of these sessions, so the churn rate is the same from the first second on.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

SHAPES = {"exponential": 1.0, "weibull": 0.5}
"""The shape of each kind; Weibull with 0.5 fits measurements of file-sharing networks: most sessions are short."""
KINDS = (*SHAPES, "fixed")


@dataclass(frozen=True)
class DurationDistribution:
    """A distribution of the given ``kind`` with the median ``median`` in seconds."""

    kind: str
    median: float

    @property
    def mean(self) -> float:
        """The mean duration in seconds."""
        if self.kind == "fixed":
            return self.median
        return self._scale * math.gamma(1 + 1 / SHAPES[self.kind])

    def draw(self, rng: random.Random) -> float:
        """Draw a duration in seconds."""
        if self.kind == "fixed":
            return self.median
        return float(self._scale * rng.expovariate(1.0) ** (1 / SHAPES[self.kind]))

    def draw_remaining(self, rng: random.Random) -> float:
        """Draw the remaining duration of a session in progress, in seconds."""
        if self.kind == "fixed":
            return self.median * rng.random()
        shape = SHAPES[self.kind]
        # If sessions are weighted by length, the exponential variable of the Weibull becomes a gamma variable.
        whole = self._scale * rng.gammavariate(1 + 1 / shape, 1.0) ** (1 / shape)
        return float(whole * rng.random())

    @property
    def _scale(self) -> float:
        return float(self.median / math.log(2) ** (1 / SHAPES[self.kind]))
