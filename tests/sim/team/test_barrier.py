"""Tests of what keeps datagrams from passing."""

from __future__ import annotations

from itertools import combinations

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.network.network import Address
from sim.team.faults.barrier import clog, cut, deaf, mute, pairs

A, B, C = (Address(host, 7000) for host in ("a", "b", "c"))


class BarrierTests(SynchronousTestCase):
    """Who can still write to whom."""

    def test_each_kind_stops_what_it_should(self) -> None:
        """Cut both ways, deaf and mute one way, all three but among themselves; clogged from and to everybody."""
        table = {
            cut(["a", "b"]): {(A, C), (C, A), (B, C), (C, B)},
            deaf(["a", "b"]): {(C, A), (C, B)},
            mute(["a", "b"]): {(A, C), (B, C)},
            clog("a"): {(A, B), (B, A), (A, C), (C, A)},
        }
        for barrier, stopped in table.items():
            found = {(x, y) for x in (A, B, C) for y in (A, B, C) if x != y and barrier(x, y)}
            self.assertEqual(found, stopped)

    def test_pairs_are_a_share_and_the_same_both_ways(self) -> None:
        """About that share of all pairs is cut, in both directions, and others with another salt."""
        nodes = [Address(f"10.0.0.{number}", 7000) for number in range(150)]
        barrier, other = pairs(0.05, "1"), pairs(0.05, "2")
        cut_off = [(a, b) for a, b in combinations(nodes, 2) if barrier(a, b)]
        self.assertApproximates(len(cut_off) / (150 * 149 / 2), 0.05, 0.01)
        self.assertTrue(all(barrier(b, a) for a, b in cut_off))
        self.assertLess(sum(other(a, b) for a, b in cut_off) / len(cut_off), 0.2)
