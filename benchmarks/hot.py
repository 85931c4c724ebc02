"""Measure a put, a get and a join in processor time and datagrams, summed over all nodes of a team.

All nodes are in one process, connected by a switchboard in virtual time, so the datagrams are the same on every
machine. Therefore runs before and after a change can be compared. The time includes the simulation.
"""

from __future__ import annotations

import argparse
import cProfile
import gc
import math
import pstats
import sys
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred

from benchmarks.idle import Team
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import hash_key

STEP_S = 0.0001
SETTLE_S = 5.0
QUARTERS = 4


class OperationBenchmark:
    """A settled team of ``n`` nodes, measured one operation after the other."""

    def __init__(self, n: int) -> None:
        self.team = Team(n, 1)
        self.team.clock.advance(SETTLE_S)
        self.failed = 0

    def wait(self, work: Deferred[Any]) -> None:
        """Advance the clock until ``work`` is done."""
        ended: list[Any] = []
        work.addErrback(self._count_failure).addCallback(ended.append)
        while not ended:
            self.team.clock.advance(STEP_S)

    def measure_each(self, work: Callable[[int], Deferred[Any]], times: int, wide: int = 1) -> str:
        """Run ``times`` operations, ``wide`` of them in parallel; return the cost of one in the best quarter."""
        self.failed = 0
        gc.collect()
        sent, moment = self.team.total_traffic.sent, self.team.clock.seconds()
        quarter, best = -(-times // QUARTERS), math.inf
        for start in range(0, times, quarter):
            started_at, end = time.process_time(), min(times, start + quarter)
            for first in range(start, end, wide):
                for waiting in [work(number) for number in range(first, min(end, first + wide))]:
                    self.wait(waiting)
            best = min(best, (time.process_time() - started_at) / (end - start))
        span = self.team.clock.seconds() - moment
        cost = f"{best * 1e6:7.0f} us of CPU {(self.team.total_traffic.sent - sent) / times:6.1f} datagrams"
        return f"{cost} {span / times * 1e3:6.2f} ms, {self.failed} failed"

    def _count_failure(self, failure: Any) -> None:
        self.failed += 1

    def measure_join(self, place: int) -> str:
        """Return the cost of a new node: its join, its first read of an existing key, and the next five seconds."""
        clock = self.team.clock
        newcomer = self.team.make_node(place)
        lines = []
        sent, moment, started_at = self.team.total_traffic.sent, clock.seconds(), time.process_time()

        def lap(what: str) -> None:
            cpu, span = (time.process_time() - started_at) * 1e3, (clock.seconds() - moment) * 1e3
            lines.append(f"{what} {cpu:.1f} ms of CPU, {self.team.total_traffic.sent - sent} datagrams, {span:.1f} ms")

        newcomer.start()
        self.wait(newcomer.join([self.team.address(0)]))
        lap("joined:")
        self.wait(newcomer.get(hash_key("h7"), "fast"))
        lap("read:")
        clock.advance(5.0)
        lap("5 s later:")
        self.team.nodes.append(newcomer)
        return "; ".join(lines)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.hot", description=__doc__)
    parser.add_argument("--nodes", type=int, default=16)
    parser.add_argument("--times", type=int, default=400)
    parser.add_argument("--joins", type=int, default=3)
    parser.add_argument("--flood", type=int, default=0, help="number of puts of one node, 64 at a time")
    parser.add_argument("--profile", action="store_true", help="print a profile of the puts and gets")
    arguments = parser.parse_args()
    hot = OperationBenchmark(arguments.nodes)
    nodes, times = list(hot.team.nodes), arguments.times
    key = [hash_key(f"h{number}") for number in range(times)]
    profile = cProfile.Profile()
    if arguments.profile:
        profile.enable()

    def remote(number: int) -> EntangledNode:
        """Return a node that does not store the key, if there is one."""
        at = key[number % 50]
        others = [node for node in nodes if not node.replica.get_held(at)] or nodes
        return others[number % len(others)]

    print("put         ", hot.measure_each(lambda n: nodes[n % len(nodes)].put(key[n], "v", b"x" * 100), times))
    requester = {number: remote(number) for number in range(times)}
    print("get fast    ", hot.measure_each(lambda n: requester[n].get(key[n % 50], "fast"), times))
    print("get majority", hot.measure_each(lambda n: requester[n].get(key[n % 50], "majority"), times))
    if arguments.profile:
        profile.disable()
        pstats.Stats(profile).sort_stats("tottime").print_stats(35)
    if arguments.flood:
        flooded = hot.measure_each(lambda n: nodes[1].put(hash_key(f"f{n}"), "v", b"x" * 100), arguments.flood, 64)
        dropped: Counter[str] = Counter()
        for node in nodes:
            dropped += node.endpoint.counters
        print("flood       ", flooded, dict(dropped))
    for place in range(arguments.joins):
        print("join", hot.measure_join(200 + place))
    return 0


if __name__ == "__main__":
    sys.exit(main())
