"""Tests of the score of a link."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.control.link import link


class LinkTests(SynchronousTestCase):
    def test_scores(self) -> None:
        """A steady peer on the same LAN has all points, one that answers at all has one, a silent one none."""
        rows: list[tuple[list[float | None], bool, int]] = [
            ([0.002, 0.0021, 0.0019, 0.002], False, 100),
            ([0.4, 0.9, None, None, None, None], True, 1),
            ([None] * 10, False, 0),
        ]
        for times, is_relayed, score in rows:
            self.assertEqual(link(times, is_relayed).score, score)
        self.assertEqual((link([None], False).loss, link([None], False).round_trip), (1.0, None))

    def test_a_second_try_counts_as_a_loss(self) -> None:
        """An answer that came so late that it was asked for twice is a loss, and does not spoil the round trip."""
        found = link([0.002] * 8 + [0.055, 0.11], False)
        self.assertEqual((found.loss, found.round_trip), (0.2, 0.002))
        found = link([0.1] * 8 + [0.26, None], False)
        self.assertEqual((round(found.loss, 3), found.round_trip), (0.2, 0.1))

    def test_each_trouble_costs(self) -> None:
        """Loss, delay, jitter and a relay each take points, and more of it takes more."""
        best = link([0.002] * 10, False).score
        lossy = [link([0.002] * (10 - n) + [None] * n, False).score for n in (1, 2, 3)]
        late = [link([seconds] * 10, False).score for seconds in (0.05, 0.1, 0.2)]
        shaky = [link([0.02 - by, 0.02 + by] * 5, False).score for by in (0.005, 0.01)]
        for scores in (lossy, late, shaky, [link([0.002] * 10, True).score]):
            self.assertEqual([best, *scores], sorted([best, *scores], reverse=True))
            self.assertLess(scores[0], best)
