"""Measure and check the tuple space, which only this library has."""

from __future__ import annotations

import asyncio

from benchmarks.dht.meter import Meter
from benchmarks.dht.team import Node
from benchmarks.dht.workload import Result, Workload, summarize
from benchmarks.remote import OrderFailed

PUTS = 30
CONCURRENT_PUTS = 30
WAKE_UPS = 10
RACES = 10
TAKERS = 4
OPERATION_LIMIT_S = 5.0
WAIT_BEFORE_PUT_S = 0.3
"""Seconds before the put at which a node starts to wait for the tuple."""

Fields = list[object]


async def measure_space(workload: Workload) -> None:
    """Measure single operations, concurrent puts of many writers, wake-ups, and takes by competing nodes."""
    if "space" not in workload.team.library.features:
        return
    count = workload.plan.scale_count(PUTS)
    async with workload.phase("tuple space", 180.0):
        try:
            for node in workload.nodes:
                await _run_operation(node, "open", [])
        except OrderFailed as error:
            workload.result.setdefault("skipped", {})["tuple space"] = str(error)
            return
        result: Result = workload.result.setdefault("space", {})
        result["put"] = await _measure_singles(workload, "put", [["job", n, 7] for n in range(count)])
        result["read"] = await _measure_singles(workload, "read_if_exists", [["job", n, None] for n in range(count)])
        result["take"] = await _measure_singles(workload, "get_if_exists", [["job", n, None] for n in range(count)])
        result["crowd"] = await _measure_concurrent(workload)
        result["wake"] = await _measure_wakeups(workload)
        result["race"] = await _measure_races(workload)


async def _run_operation(node: Node, verb: str, fields: Fields) -> Result:
    return await node.run_order("space", OPERATION_LIMIT_S + 5.0, verb=verb, fields=fields, limit_s=OPERATION_LIMIT_S)


async def _measure_singles(workload: Workload, verb: str, works: list[Fields]) -> Result:
    """Measure operations one after the other, each at a random node."""
    meter = Meter(workload.team.pids)
    done = [await _run_operation(workload.rng.choice(workload.nodes), verb, fields) for fields in works]
    good = [each["ms"] for each in done if each["good"]]
    return {**summarize(good), "failed": len(done) - len(good), **meter.read().per_operation(len(done), workload.idle)}


async def _measure_concurrent(workload: Workload) -> Result:
    """Put tuples at random nodes without pauses, and count the tuples that are found directly after."""
    count = workload.plan.scale_count(CONCURRENT_PUTS)
    await asyncio.gather(
        *(_run_operation(workload.rng.choice(workload.nodes), "put", ["crowd", n, 7]) for n in range(count))
    )
    asked = [
        await _run_operation(workload.rng.choice(workload.nodes), "read_if_exists", ["crowd", n, None])
        for n in range(count)
    ]
    return {"found_percent": 100 * sum(each["good"] for each in asked) / count}


async def _measure_wakeups(workload: Workload) -> Result:
    """Measure the time from the start of a put until a waiting taker has the tuple."""
    took: list[float] = []
    count = workload.plan.scale_count(WAKE_UPS)
    for number in range(count):
        taker, putter = workload.rng.sample(workload.nodes, 2)
        waiting = asyncio.ensure_future(_run_operation(taker, "get", ["wake", number, None]))
        await asyncio.sleep(WAIT_BEFORE_PUT_S)
        begun = (await _run_operation(putter, "put", ["wake", number, 7]))["moments"][0]
        taken = await waiting
        if taken["good"]:
            took.append((taken["moments"][1] - begun) * 1000)
    return {**summarize(took), "lost": count - len(took), "of": count}


async def _measure_races(workload: Workload) -> Result:
    """Let several nodes take one tuple at the same time; count the races with exactly one winner."""
    single = 0
    count = workload.plan.scale_count(RACES)
    for number in range(count):
        putter, *takers = workload.rng.sample(workload.nodes, min(TAKERS + 1, len(workload.nodes)))
        await _run_operation(putter, "put", ["race", number, 7])
        taken = await asyncio.gather(
            *(_run_operation(taker, "get_if_exists", ["race", number, None]) for taker in takers)
        )
        single += sum(each["good"] for each in taken) == 1
    return {"single_winner": single, "of": count}
