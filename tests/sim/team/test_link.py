"""Tests of the simulated links and barriers between nodes."""

from __future__ import annotations

import random
from itertools import combinations
from statistics import fmean

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.network.network import Address
from sim.team.faults.barrier import block_host, block_incoming, block_outgoing, block_pairs, isolate
from sim.team.link import LinkSettings, TeamLink

NODES = [Address(f"10.0.0.{number}", 7000) for number in range(200)]
A, B, C = NODES[:3]


def _sent(link: TeamLink, count: int, gap: float = 0.001, source: Address = A, to: Address = B) -> list[list[float]]:
    rng = random.Random(1)
    return [list(link.draw_delays(source, to, 100, turn * gap, rng)) for turn in range(count)]


class TeamLinkTests(SynchronousTestCase):
    """Tests of ``TeamLink``."""

    def test_internet_has_the_distances_of_the_literature(self) -> None:
        """Round trips take 156 ms on average; the delay of a pair is symmetric and depends on the seed."""
        link, rng = TeamLink(LinkSettings("internet"), "1"), random.Random(2)
        trips = [2 * link.distance(*rng.sample(NODES, 2)) for _ in range(4000)]
        self.assertApproximates(fmean(trips), 0.156, 0.012)
        self.assertGreater(max(trips), 0.25)
        self.assertEqual(link.distance(A, B), link.distance(B, A))
        self.assertEqual(link.distance(A, B), TeamLink(LinkSettings("internet"), "1").distance(A, B))
        self.assertNotEqual(link.distance(A, B), TeamLink(LinkSettings("internet"), "2").distance(A, B))
        delays = [delay for (delay,) in _sent(link, 500)]
        self.assertTrue(all(abs(delay / link.distance(A, B) - 1) <= 0.0501 for delay in delays))

    def test_lan_and_radio_are_near(self) -> None:
        """A LAN adds a delay of 0.2 to 0.6 ms, WiFi 5 ms on average, and ``none`` no delay."""
        self.assertTrue(all(0.0002 <= delay <= 0.0006 for (delay,) in _sent(TeamLink(LinkSettings("lan"), "1"), 500)))
        self.assertApproximates(
            fmean(delay for (delay,) in _sent(TeamLink(LinkSettings("wifi"), "1"), 5000)), 0.005, 5e-4
        )
        self.assertEqual(_sent(TeamLink(LinkSettings("none"), "1"), 3), [[0.0]] * 3)

    def test_loss_comes_one_by_one_or_in_bursts(self) -> None:
        """With and without bursts the loss rate is the same; with bursts most losses are consecutive."""
        for burst, follow in ((0.0, 0.1), (0.02, 0.95)):
            lost = [not delays for delays in _sent(TeamLink(LinkSettings("lan", loss=0.1, burst=burst), "1"), 60_000)]
            self.assertApproximates(sum(lost) / len(lost), 0.1, 0.015)
            pairs = [b for a, b in zip(lost, lost[1:], strict=False) if a]
            self.assertApproximates(sum(pairs) / len(pairs), follow, 0.02, f"burst {burst}")

    def test_one_direction_is_worse(self) -> None:
        """With asymmetry one direction of a pair loses more datagrams than the other; the mean loss does not change."""
        link = TeamLink(LinkSettings("lan", loss=0.2, asymmetry=0.5), "1")
        there = sum(not delays for delays in _sent(link, 20_000))
        back = sum(not delays for delays in _sent(link, 20_000, source=B, to=A))
        self.assertApproximates(there / 20_000, 0.3, 0.02)
        self.assertApproximates(back / 20_000, 0.1, 0.02)

    def test_datagrams_are_doubled_and_overtaken(self) -> None:
        """The rates of duplicated and reordered datagrams match the settings."""
        link = TeamLink(LinkSettings("lan", duplicate=0.1, reorder=0.2), "1")
        sent = _sent(link, 10_000)
        self.assertApproximates(sum(len(delays) == 2 for delays in sent) / 10_000, 0.1, 0.02)
        all_delays = [delay for delays in sent for delay in delays]
        self.assertApproximates(sum(delay > 0.0006 for delay in all_delays) / len(all_delays), 0.2, 0.02)

    def test_a_line_carries_so_much_and_no_more(self) -> None:
        """Datagrams beyond the bandwidth wait in a queue; datagrams beyond the queue limit are lost."""
        link = TeamLink(LinkSettings("none", bandwidth=1000.0, queue=0.5), "1")  # 100 bytes take 0.1 s
        sent = _sent(link, 10, gap=0.0)
        self.assertEqual([round(delays[0], 3) for delays in sent[:6]], [0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
        self.assertEqual(sent[6:], [[]] * 4)
        self.assertEqual(
            len(link.draw_delays(B, A, 100, 0.0, random.Random(1))), 1, "another sender has a line of its own"
        )
        self.assertApproximates(link.draw_delays(A, B, 100, 10.0, random.Random(1))[0], 0.1, 1e-9)

    def test_bad_weather_is_lost_besides(self) -> None:
        """If ``extra_loss`` is set, it adds to the loss of the link."""
        link = TeamLink(LinkSettings("lan"), "1")
        link.extra_loss = 0.5
        self.assertApproximates(sum(not delays for delays in _sent(link, 4000)) / 4000, 0.5, 0.03)
        link.extra_loss = 0.0
        self.assertTrue(all(_sent(link, 100)))


class BarrierTests(SynchronousTestCase):
    """Barriers block datagrams between nodes."""

    def test_each_kind_stops_what_it_should(self) -> None:
        """``isolate`` blocks both directions of a group, ``block_incoming`` and ``block_outgoing`` block one direction.

        ``block_host`` blocks a host.
        """
        table = {
            isolate([A.host, B.host]): {(A, C), (C, A), (B, C), (C, B)},
            block_incoming([A.host, B.host]): {(C, A), (C, B)},
            block_outgoing([A.host, B.host]): {(A, C), (B, C)},
            block_host(A.host): {(A, B), (B, A), (A, C), (C, A)},
        }
        for barrier, stopped in table.items():
            found = {(x, y) for x in (A, B, C) for y in (A, B, C) if x != y and barrier(x, y)}
            self.assertEqual(found, stopped)

    def test_pairs_are_a_share_and_the_same_both_ways(self) -> None:
        """``pairs`` blocks the given share of all pairs in both directions.

        A different salt selects different pairs.
        """
        nodes = NODES[:150]
        barrier, other = block_pairs(0.05, "1"), block_pairs(0.05, "2")
        cut_off = [(a, b) for a, b in combinations(nodes, 2) if barrier(a, b)]
        self.assertApproximates(len(cut_off) / (150 * 149 / 2), 0.05, 0.01)
        self.assertTrue(all(barrier(b, a) for a, b in cut_off))
        self.assertLess(sum(other(a, b) for a, b in cut_off) / len(cut_off), 0.2)
