"""Run the workload of each library while all nodes are healthy, in phases with time limits.

Each phase adds its figures to the result; the reason for an early end of a phase is stored under "trouble", and the
next phase starts.
"""

from __future__ import annotations

import asyncio
import random
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

from benchmarks.dht.meter import Cost, Meter, percentile, read_memory_mib
from benchmarks.dht.team import Node, Team
from benchmarks.remote import OrderFailed

JOINERS = 4
JOIN_LIMIT_S = 15.0
OPERATION_LIMIT_S = 15.0
SINGLES_LIMIT_S = 20.0
MAX_TRIES = 6
READ_LIMIT_S = 3.0
PHASE_LIMIT_S = 60.0
VALUE_BYTES = 100
MIN_REMOTE_SHARE = 0.1
"""Minimum share of keys that a node does not store; with fewer, its load also includes keys that it stores."""

Result = dict[str, Any]


@dataclass(frozen=True)
class Plan:
    """Size of the workload: ``seconds`` of each load, ``keys`` single operations; ``seed`` selects the nodes.

    A short load also shortens the pauses before it.
    """

    keys: int = 200
    seconds: float = 5.0
    in_flight: int = 32
    load_keys: int = 2000
    seed: int = 1
    profile: str = ""

    def scale_pause(self, seconds: float) -> float:
        """Return a pause of ``seconds``, shorter in a short run."""
        return min(seconds, self.seconds)

    def scale_count(self, count: int) -> int:
        """Return ``count``, or less in a run with few keys."""
        return max(2, min(count, count * self.keys // 200))


class Workload:
    """One run of one team; each phase adds to ``result``."""

    def __init__(self, team: Team, plan: Plan, result: Result) -> None:
        self.team = team
        self.nodes = team.nodes
        self.plan = plan
        self.result = result
        self.rng = random.Random(f"{plan.seed}/{len(team.nodes)}")
        self.idle = Cost()

    @asynccontextmanager
    async def phase(self, name: str, limit_s: float = PHASE_LIMIT_S) -> AsyncIterator[None]:
        """Limit the time of a phase, and record the reason of an early end."""
        try:
            async with asyncio.timeout(limit_s):
                yield
        except OrderFailed as error:
            self.result.setdefault("trouble", {})[name] = str(error)
        except TimeoutError:
            self.result.setdefault("trouble", {})[name] = f"not through within {limit_s:g} s"

    # -- parts of phases ----------------------------------------------------------------------------------------------

    async def start_nodes(self, nodes: list[Node]) -> None:
        """Start these nodes one after the other with the first one as contact, and wait until all nodes work.

        Some libraries report a join or a stored value before other nodes can find it.
        """
        first = self.nodes[0]
        for node in nodes:
            await node.run_order("start", port=node.port, known=0 if node is first else first.port)
        await asyncio.sleep(self.plan.scale_pause(4.0))
        for number, node in enumerate(nodes):
            await self.store_until_found(node, nodes[number - 1], f"ready {number}")

    async def store_until_found(self, writer: Node, reader: Node, key: str) -> tuple[str, str]:
        """Store new values until ``reader`` finds one; return its key and the value; raises ``OrderFailed``."""
        for number in range(MAX_TRIES):
            value = self.make_value()
            put = await self.run_operation(writer, "put", f"{key} try {number}", value)
            if (
                put["good"]
                and (await self.run_operation(reader, "get", f"{key} try {number}", value, READ_LIMIT_S))["good"]
            ):
                return f"{key} try {number}", value
            await asyncio.sleep(1.0)
        raise OrderFailed(f"other nodes do not find the values that the node on port {writer.port} puts")

    async def run_operation(
        self, node: Node, kind: str, key: str, value: str | int, limit_s: float = OPERATION_LIMIT_S
    ) -> Result:
        """Execute one operation."""
        return await node.run_order("once", limit_s + 5.0, kind=kind, key=key, value=value, limit_s=limit_s)

    async def run_singles(self, kind: str, works: list[tuple[Node, str, str]]) -> Result:
        """Execute one operation after the other, each at its node."""
        took, failed = [], 0
        ends_at = time.monotonic() + SINGLES_LIMIT_S
        meter = Meter(self.team.pids)
        for node, key, value in works:
            if time.monotonic() > ends_at:
                break
            outcome = await self.run_operation(node, kind, key, value)
            failed += not outcome["good"]
            if outcome["good"]:
                took.append(outcome["ms"])
        tried = len(took) + failed
        return {**summarize(took), "tried": tried, "failed": failed, **meter.read().per_operation(tried, self.idle)}

    async def run_load(
        self, node: Node, kind: str, items: list[tuple[str, str]], in_flight: int, seconds: float, once: bool
    ) -> Result:
        """Execute many operations of one node concurrently."""
        order = {"kind": kind, "items": items, "in_flight": in_flight, "seconds": seconds, "once": once}
        return await node.run_order("load", seconds + OPERATION_LIMIT_S, **order, limit_s=OPERATION_LIMIT_S)

    def make_value(self) -> str:
        """Return a new value."""
        return self.rng.randbytes(VALUE_BYTES).hex()

    # -- phases -----------------------------------------------------------------------------------------------------

    async def run_healthy(self) -> bool:
        """Measure joins, the idle network, single and concurrent operations, memory; return False if a join failed."""
        joiners = min(JOINERS, len(self.nodes) - 2)
        async with self.phase("join", 3 * PHASE_LIMIT_S):
            await self.start_nodes(self.nodes[: len(self.nodes) - joiners])
            self.result["join_ms"] = await self._measure_joins(joiners)
        if "trouble" in self.result:
            return False
        async with self.phase("idle"):
            await self._measure_idle()
        items = [(f"single {n}", self.make_value()) for n in range(self.plan.keys)]
        held: list[list[bool | None]] = []
        async with self.phase("singles", 4 * PHASE_LIMIT_S):
            held = await self._measure_single(items)
        if held:
            async with self.phase("load", 2 * PHASE_LIMIT_S):
                await self._measure_load(items, held)
        memory = [read_memory_mib(pid) for pid in self.team.pids]
        self.result["rss_mib"] = percentile([rss for rss, _ in memory], 50)
        self.result["uss_mib"] = percentile([uss for _, uss in memory], 50)
        return True

    async def _measure_joins(self, joiners: int) -> list[float | None]:
        """Measure for each of the last nodes the time until it has read an existing key."""
        old = self.nodes[: len(self.nodes) - joiners]
        took: list[float | None] = []
        for number, node in enumerate(self.nodes[len(old) :]):
            writer, reader = self.rng.sample(old, 2)
            wanted = await self.store_until_found(writer, reader, f"early {number}")
            order = {"port": node.port, "known": self.nodes[0].port, "wanted": wanted, "limit_s": JOIN_LIMIT_S}
            took.append((await node.run_order("start", **order))["join_ms"])
        return took

    async def _measure_idle(self) -> None:
        await asyncio.sleep(self.plan.scale_pause(4.0))
        meter = Meter(self.team.pids)
        await asyncio.sleep(self.plan.scale_pause(3.0))
        self.idle = meter.read()
        share = 1 / self.idle.seconds / len(self.nodes)
        self.result["idle"] = {
            "datagrams_per_s": self.idle.datagrams * share,
            "core_percent": 100 * self.idle.cpu_s * share,
        }

    async def _measure_single(self, items: list[tuple[str, str]]) -> list[list[bool | None]]:
        """Put and get one at a time; return the keys that each node stores."""
        nodes, count = self.nodes, range(len(self.nodes))
        writers = [self.rng.choice(count) for _ in items]
        works = [(nodes[w], *item) for w, item in zip(writers, items, strict=True)]
        self.result["put"] = await self.run_singles("put", works)
        await asyncio.sleep(self.plan.scale_pause(0.5))
        held = [(await node.run_order("holds", keys=[key for key, _ in items]))["holds"] for node in nodes]
        readers = [self.rng.choice([n for n in count if n != writer]) for writer in writers]
        reads = [(nodes[r], *item) for r, item in zip(readers, items, strict=True)]
        self.result["get"] = await self.run_singles("get", reads)
        remote = [read for n, read in enumerate(reads) if held[readers[n]][n] is not True]
        self.result["local_share"] = 1 - len(remote) / len(reads)
        if len(remote) == len(reads):
            self.result["remote_get"] = self.result["get"]
        elif remote:
            self.result["remote_get"] = await self.run_singles("get", remote)
        return held

    async def _measure_load(self, items: list[tuple[str, str]], held: list[list[bool | None]]) -> None:
        """Measure the operations that one node completes with a given number of operations in flight."""
        loaded = self.nodes[len(self.nodes) // 2]
        mine = held[len(self.nodes) // 2]
        # In a small network a node stores nearly all keys: then its reads are local.
        far = [item for n, item in enumerate(items) if mine[n] is not True]
        if len(far) < len(items) * MIN_REMOTE_SHARE:
            far = items
        self.result["load_local_share"] = sum(mine[n] is True for n, item in enumerate(items) if item in far) / len(far)
        new = [(f"load {n}", self.make_value()) for n in range(self.plan.load_keys)]
        for name, kind, wanted in (("gets", "get", far), ("puts", "put", new)):
            await asyncio.sleep(self.plan.scale_pause(0.5))
            await self._profile(loaded)
            meter = Meter(self.team.pids)
            outcome = await self.run_load(loaded, kind, wanted, self.plan.in_flight, self.plan.seconds, once=False)
            cost = meter.read()
            await self._profile(loaded, kind)
            self.result[name] = {
                "per_s": outcome["good"] / outcome["seconds"],
                **summarize(outcome["ms"]),
                "tried": outcome["tried"],
                "failed": outcome["tried"] - outcome["good"],
                "unfinished": outcome["unfinished"],
                **cost.per_operation(outcome["good"], self.idle),
            }

    async def _profile(self, loaded: Node, kind: str = "") -> None:
        """Start to profile the loaded node and another one, or write the profiles."""
        prefix = f"{self.plan.profile}-{self.team.library.name}-{len(self.nodes)}"
        for node, name in ((loaded, "loaded"), (self.nodes[0], "other")) if self.plan.profile else ():
            await node.run_order("profile", file=kind and f"{prefix}-{name}.{kind}")


def summarize(took: list[float]) -> Result:
    """Return statistics of a list of milliseconds."""
    return {"p50": percentile(took, 50), "p95": percentile(took, 95), "max": max(took, default=None)}
