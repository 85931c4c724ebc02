"""Tests of how long nodes stay."""

from __future__ import annotations

import random
from statistics import fmean, median

from twisted.trial.unittest import SynchronousTestCase

from sim.team.session import KINDS, Session


class SessionTests(SynchronousTestCase):
    """Behaviour of ``Session``."""

    def test_half_of_them_are_shorter_than_the_median(self) -> None:
        """Drawn durations have the median and the mean that they should have."""
        for kind in KINDS:
            session, rng = Session(kind, 60.0), random.Random(1)
            drawn = [session.drawn(rng) for _ in range(40_000)]
            self.assertApproximates(median(drawn), 60.0, 2.0, kind)
            self.assertApproximates(fmean(drawn) / session.mean, 1.0, 0.06, kind)

    def test_rate_of_leaving_is_the_same_from_the_start(self) -> None:
        """Of many sessions met under way, as many end in the first seconds as in any others: n / mean a second."""
        for kind in KINDS:
            session, rng = Session(kind, 60.0), random.Random(2)
            ends = []
            for _ in range(20_000):
                moment = session.left(rng)
                while moment < 60.0:
                    ends.append(moment)
                    moment += session.drawn(rng)
            expected = 20_000 / session.mean * 20.0
            for start in (0.0, 20.0, 40.0):
                count = sum(start <= moment < start + 20 for moment in ends)
                self.assertApproximates(count / expected, 1.0, 0.08, f"{kind} from {start}")
