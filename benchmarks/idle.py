"""Measure an idle team, and a read and a write, in datagrams, bytes and processor time.

Everything runs in virtual time on a switchboard in one process, so the figures are the same on every machine, except
for the share of a core, which includes the simulation.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred

from middleware.entangled.errors import EntangledError
from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import hash_key
from sim.team.simulation import EntangledTeam

MAX_BYTES_S = 1000.0
MAX_CORE_SHARE = 0.001
IP_UDP_HEADER_BYTES = 28
"""Bytes of the IP and UDP headers of a datagram."""


class Team(EntangledTeam):
    """``n`` nodes in one network with a one-way delay of 0.2 ms."""

    def __init__(self, n: int, seed: int) -> None:
        super().__init__(n, seed, LinkConditions(delay_s=0.0002))
        self.random = random.Random(seed)

    def count_sent(self) -> tuple[int, int]:
        """Return the datagrams and bytes that all nodes have sent."""
        return self.total_traffic.sent, self.total_traffic.sent_bytes + IP_UDP_HEADER_BYTES * self.total_traffic.sent

    def measure_idle(self, seconds: float) -> tuple[float, float, float]:
        """Return the datagrams and bytes that an idle node sends per second, and its share of a core."""
        before, started_at = self.count_sent(), time.process_time()
        self.clock.advance(seconds)
        elapsed = time.process_time() - started_at
        each = seconds * len(self.nodes)
        datagrams, octets = self.count_sent()
        return (datagrams - before[0]) / each, (octets - before[1]) / each, elapsed / each

    def measure_operations(
        self, work: Callable[[EntangledNode], Deferred[Any]], times: int
    ) -> tuple[float, list[float], int]:
        """Return datagrams per operation (``times`` operations at random nodes), durations, and failures."""
        before, failed = self.total_traffic.sent, 0
        took: list[float] = []
        for _ in range(times):
            started_at = self.clock.seconds()
            ended: list[Any] = []
            done = work(self.random.choice([node for node in self.nodes if node._running]))
            done.addErrback(lambda failure: failure.trap(EntangledError)).addCallback(ended.append)
            while not ended:
                self.clock.advance(0.0001)
            took.append(self.clock.seconds() - started_at)
            failed += isinstance(ended[0], type) or ended[0] == []
        self.clock.advance(0.05)
        return (self.total_traffic.sent - before) / times, sorted(took), failed


def main() -> int:
    """Print the table; return 1 if the idle team exceeds its limits."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.idle", description=__doc__)
    parser.add_argument("--nodes", type=int, default=30)
    parser.add_argument("--seconds", type=float, default=120.0, help="virtual time (default 120)")
    parser.add_argument("--loss", action="store_true", help="also read after half of the nodes became silent")
    arguments = parser.parse_args()
    team = Team(arguments.nodes, 1)
    team.clock.advance(30.0)
    datagrams, octets, core = team.measure_idle(arguments.seconds)
    idle = f"{datagrams:.1f} datagrams/s, {octets:.0f} bytes/s, {core:.3%} of a core each"
    print_line(f"idle, {arguments.nodes} nodes: {idle}")
    numbers = iter(range(10**6))
    puts = team.measure_operations(lambda node: node.put(hash_key(f"k{next(numbers)}"), "v", b"x" * 100), 200)
    print_row("put", puts)
    print_row("get fast", team.measure_operations(lambda node: node.get(choose_key(team.random), "fast"), 200))
    print_row("get majority", team.measure_operations(lambda node: node.get(choose_key(team.random), "majority"), 200))
    if arguments.loss:
        for node in team.random.sample(team.nodes, len(team.nodes) // 2):
            node.stop_silently()
        print_row(
            "get fast, half silent",
            team.measure_operations(lambda node: node.get(choose_key(team.random), "fast"), 100),
        )
    return int(octets > MAX_BYTES_S or core > MAX_CORE_SHARE)


def choose_key(rng: random.Random) -> bytes:
    """Return one of the stored keys."""
    return hash_key(f"k{rng.randrange(200)}")


def print_line(line: str) -> None:
    """Print a line."""
    sys.stdout.write(line + "\n")


def print_row(what: str, figures: tuple[float, list[float], int]) -> None:
    """Print one row."""
    datagrams, took, failed = figures
    p50, p95 = took[len(took) // 2], took[len(took) * 95 // 100]
    print_line(
        f"{what}: {datagrams:.1f} datagrams, p50 {p50 * 1000:.1f} ms, p95 {p95 * 1000:.1f} ms, "
        f"max {took[-1] * 1000:.1f} ms, {failed} of {len(took)} without a result"
    )


if __name__ == "__main__":
    sys.exit(main())
