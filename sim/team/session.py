"""Session: how long nodes stay, and how long they are away, as drawn from a distribution with a given median.

A team that is watched from some moment on has been alive before: what is left of a node's session then is not a fresh
draw, for long sessions are the ones that are met (the inspection paradox).  ``left`` draws that, so that the rate of
churn is the same from the first second to the last.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

SHAPES = {"exponential": 1.0, "weibull": 0.5}
"""Weibull with a shape of 0.5 is what measurements of file-sharing networks come to: most leave soon, some stay."""
KINDS = (*SHAPES, "fixed")


@dataclass(frozen=True)
class Session:
    """Durations of a ``kind``, half of them shorter than ``median`` seconds."""

    kind: str
    median: float

    @property
    def mean(self) -> float:
        """The mean duration, in seconds."""
        if self.kind == "fixed":
            return self.median
        return self._scale * math.gamma(1 + 1 / SHAPES[self.kind])

    def drawn(self, rng: random.Random) -> float:
        """How long one lasts, in seconds."""
        if self.kind == "fixed":
            return self.median
        return float(self._scale * rng.expovariate(1.0) ** (1 / SHAPES[self.kind]))

    def left(self, rng: random.Random) -> float:
        """How long one that is met under way still lasts."""
        if self.kind == "fixed":
            return self.median * rng.random()
        shape = SHAPES[self.kind]
        # Weighted by its own length, the exponential behind the Weibull becomes a gamma variable.
        whole = self._scale * rng.gammavariate(1 + 1 / shape, 1.0) ** (1 / shape)
        return float(whole * rng.random())

    @property
    def _scale(self) -> float:
        return float(self.median / math.log(2) ** (1 / SHAPES[self.kind]))
