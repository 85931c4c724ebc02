"""The workload of every library while all its nodes are healthy, in phases with time limits.

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

from benchmarks.dht.meter import Cost, Meter, memory_mib, percentile
from benchmarks.dht.team import Node, Team
from benchmarks.remote import Lost

JOINERS = 4
JOIN_LIMIT_S = 15.0
LIMIT_S = 15.0
SINGLE_S = 20.0
TRIES = 6
READ_S = 3.0
PHASE_S = 60.0
VALUE_BYTES = 100
LEAST_FAR = 0.1
"""Minimum share of keys that a node does not store, to use only such keys as its load."""

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

    def pause(self, seconds: float) -> float:
        """Return a pause of ``seconds``, shorter in a short run."""
        return min(seconds, self.seconds)

    def share(self, count: int) -> int:
        """Return ``count``, or less in a run with few keys."""
        return max(2, min(count, count * self.keys // 200))


class Course:
    """One run of one team; each phase adds to ``result``."""

    def __init__(self, team: Team, plan: Plan, result: Result) -> None:
        self.team = team
        self.nodes = team.nodes
        self.plan = plan
        self.result = result
        self.rng = random.Random(f"{plan.seed}/{len(team.nodes)}")
        self.idle = Cost()

    @asynccontextmanager
    async def phase(self, name: str, limit_s: float = PHASE_S) -> AsyncIterator[None]:
        """Limit the time of a phase, and record the reason of an early end."""
        try:
            async with asyncio.timeout(limit_s):
                yield
        except Lost as error:
            self.result.setdefault("trouble", {})[name] = str(error)
        except TimeoutError:
            self.result.setdefault("trouble", {})[name] = f"not through within {limit_s:g} s"

    # -- parts of phases ----------------------------------------------------------------------------------------------

    async def begin(self, nodes: list[Node]) -> None:
        """Start these nodes one after the other with the first one as contact, and wait until all work.

        Some libraries report a join or a stored value before other nodes can find it.
        """
        first = self.nodes[0]
        for node in nodes:
            await node.order("start", port=node.port, known=0 if node is first else first.port)
        await asyncio.sleep(self.plan.pause(4.0))
        for number, node in enumerate(nodes):
            await self.stored(node, nodes[number - 1], f"ready {number}")

    async def stored(self, writer: Node, reader: Node, key: str) -> tuple[str, str]:
        """Store a new value, with retries, until another node finds it; return its key and value; raises ``Lost``."""
        for number in range(TRIES):
            value = self.value()
            put = await self.once(writer, "put", f"{key} try {number}", value)
            if put["good"] and (await self.once(reader, "get", f"{key} try {number}", value, READ_S))["good"]:
                return f"{key} try {number}", value
            await asyncio.sleep(1.0)
        raise Lost(f"other nodes do not find the values that the node on port {writer.port} puts")

    async def once(self, node: Node, kind: str, key: str, value: str | int, limit_s: float = LIMIT_S) -> Result:
        """Execute one operation."""
        return await node.order("once", limit_s + 5.0, kind=kind, key=key, value=value, limit_s=limit_s)

    async def singles(self, kind: str, works: list[tuple[Node, str, str]]) -> Result:
        """Execute one operation after the other, each at its node."""
        took, failed = [], 0
        ends_at = time.monotonic() + SINGLE_S
        meter = Meter(self.team.pids)
        for node, key, value in works:
            if time.monotonic() > ends_at:
                break
            outcome = await self.once(node, kind, key, value)
            failed += not outcome["good"]
            if outcome["good"]:
                took.append(outcome["ms"])
        tried = len(took) + failed
        return {**times(took), "tried": tried, "failed": failed, **meter.read().per(tried, self.idle)}

    async def loaded(
        self, node: Node, kind: str, items: list[tuple[str, str]], in_flight: int, seconds: float, once: bool
    ) -> Result:
        """Execute many operations of one node concurrently."""
        order = {"kind": kind, "items": items, "in_flight": in_flight, "seconds": seconds, "once": once}
        return await node.order("load", seconds + LIMIT_S, **order, limit_s=LIMIT_S)

    def value(self) -> str:
        """Return a new value."""
        return self.rng.randbytes(VALUE_BYTES).hex()

    # -- phases -----------------------------------------------------------------------------------------------------

    async def steady(self) -> bool:
        """Join, rest, single operations, concurrent operations, memory; return False if the join failed."""
        joiners = min(JOINERS, len(self.nodes) - 2)
        async with self.phase("join", 3 * PHASE_S):
            await self.begin(self.nodes[: len(self.nodes) - joiners])
            self.result["join_ms"] = await self._measure_joins(joiners)
        if "trouble" in self.result:
            return False
        async with self.phase("idle"):
            await self._measure_idle()
        items = [(f"single {n}", self.value()) for n in range(self.plan.keys)]
        held: list[list[bool | None]] = []
        async with self.phase("singles", 4 * PHASE_S):
            held = await self._measure_single(items)
        if held:
            async with self.phase("load", 2 * PHASE_S):
                await self._measure_load(items, held)
        memory = [memory_mib(pid) for pid in self.team.pids]
        self.result["rss_mib"] = percentile([rss for rss, _ in memory], 50)
        self.result["uss_mib"] = percentile([uss for _, uss in memory], 50)
        return True

    async def _measure_joins(self, joiners: int) -> list[float | None]:
        """Measure for each of the last nodes the time until it has read an existing key."""
        old = self.nodes[: len(self.nodes) - joiners]
        took: list[float | None] = []
        for number, node in enumerate(self.nodes[len(old) :]):
            writer, reader = self.rng.sample(old, 2)
            wanted = await self.stored(writer, reader, f"early {number}")
            order = {"port": node.port, "known": self.nodes[0].port, "wanted": wanted, "limit_s": JOIN_LIMIT_S}
            took.append((await node.order("start", **order))["join_ms"])
        return took

    async def _measure_idle(self) -> None:
        await asyncio.sleep(self.plan.pause(4.0))
        meter = Meter(self.team.pids)
        await asyncio.sleep(self.plan.pause(3.0))
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
        self.result["put"] = await self.singles("put", works)
        await asyncio.sleep(self.plan.pause(0.5))
        held = [(await node.order("holds", keys=[key for key, _ in items]))["holds"] for node in nodes]
        readers = [self.rng.choice([n for n in count if n != writer]) for writer in writers]
        reads = [(nodes[r], *item) for r, item in zip(readers, items, strict=True)]
        self.result["get"] = await self.singles("get", reads)
        remote = [read for n, read in enumerate(reads) if held[readers[n]][n] is not True]
        self.result["local_share"] = 1 - len(remote) / len(reads)
        if len(remote) == len(reads):
            self.result["remote_get"] = self.result["get"]
        elif remote:
            self.result["remote_get"] = await self.singles("get", remote)
        return held

    async def _measure_load(self, items: list[tuple[str, str]], held: list[list[bool | None]]) -> None:
        """Measure the operations that one node completes with that many in flight."""
        loaded = self.nodes[len(self.nodes) // 2]
        mine = held[len(self.nodes) // 2]
        # In a small network a node stores all or nearly all keys: then its reads are local ones.
        far = [item for n, item in enumerate(items) if mine[n] is not True]
        if len(far) < len(items) * LEAST_FAR:
            far = items
        self.result["load_local_share"] = sum(mine[n] is True for n, item in enumerate(items) if item in far) / len(far)
        new = [(f"load {n}", self.value()) for n in range(self.plan.load_keys)]
        for name, kind, wanted in (("gets", "get", far), ("puts", "put", new)):
            await asyncio.sleep(self.plan.pause(0.5))
            await self._profile(loaded)
            meter = Meter(self.team.pids)
            outcome = await self.loaded(loaded, kind, wanted, self.plan.in_flight, self.plan.seconds, once=False)
            cost = meter.read()
            await self._profile(loaded, kind)
            self.result[name] = {
                "per_s": outcome["good"] / outcome["seconds"],
                **times(outcome["ms"]),
                "tried": outcome["tried"],
                "failed": outcome["tried"] - outcome["good"],
                "unfinished": outcome["unfinished"],
                **cost.per(outcome["good"], self.idle),
            }

    async def _profile(self, loaded: Node, kind: str = "") -> None:
        """Start to profile the loaded node and another one, or write the profiles."""
        prefix = f"{self.plan.profile}-{self.team.entry.name}-{len(self.nodes)}"
        for node, name in ((loaded, "loaded"), (self.nodes[0], "other")) if self.plan.profile else ():
            await node.order("profile", file=kind and f"{prefix}-{name}.{kind}")


def times(took: list[float]) -> Result:
    """Return statistics of a list of milliseconds."""
    return {"p50": percentile(took, 50), "p95": percentile(took, 95), "max": max(took, default=None)}
