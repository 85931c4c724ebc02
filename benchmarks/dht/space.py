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
"""Seconds for which a node waits for a tuple before the put."""

Fields = list[object]


async def measure_space(course: Workload) -> None:
    """Put, read and take one tuple at a time; concurrent tuples of many writers; wake-ups; contested takes."""
    if "space" not in course.team.library.features:
        return
    count = course.plan.scale_count(PUTS)
    async with course.phase("tuple space", 180.0):
        try:
            for node in course.nodes:
                await _run_operation(node, "open", [])
        except OrderFailed as error:
            course.result.setdefault("skipped", {})["tuple space"] = str(error)
            return
        result: Result = course.result.setdefault("space", {})
        result["put"] = await _measure_singles(course, "put", [["job", n, 7] for n in range(count)])
        result["read"] = await _measure_singles(course, "read_if_exists", [["job", n, None] for n in range(count)])
        result["take"] = await _measure_singles(course, "get_if_exists", [["job", n, None] for n in range(count)])
        result["crowd"] = await _measure_concurrent(course)
        result["wake"] = await _measure_wakeups(course)
        result["race"] = await _measure_races(course)


async def _run_operation(node: Node, verb: str, fields: Fields) -> Result:
    return await node.run_order("space", OPERATION_LIMIT_S + 5.0, verb=verb, fields=fields, limit_s=OPERATION_LIMIT_S)


async def _measure_singles(course: Workload, verb: str, works: list[Fields]) -> Result:
    """One after the other, each at a random node."""
    meter = Meter(course.team.pids)
    done = [await _run_operation(course.rng.choice(course.nodes), verb, fields) for fields in works]
    good = [each["ms"] for each in done if each["good"]]
    return {**summarize(good), "failed": len(done) - len(good), **meter.read().per_operation(len(done), course.idle)}


async def _measure_concurrent(course: Workload) -> Result:
    """Put tuples at random nodes without pauses, and count the tuples that are found directly after."""
    count = course.plan.scale_count(CONCURRENT_PUTS)
    await asyncio.gather(
        *(_run_operation(course.rng.choice(course.nodes), "put", ["crowd", n, 7]) for n in range(count))
    )
    asked = [
        await _run_operation(course.rng.choice(course.nodes), "read_if_exists", ["crowd", n, None])
        for n in range(count)
    ]
    return {"found_percent": 100 * sum(each["good"] for each in asked) / count}


async def _measure_wakeups(course: Workload) -> Result:
    """Measure the time from the start of a put until a waiting taker has the tuple."""
    took: list[float] = []
    count = course.plan.scale_count(WAKE_UPS)
    for number in range(count):
        taker, putter = course.rng.sample(course.nodes, 2)
        waiting = asyncio.ensure_future(_run_operation(taker, "get", ["wake", number, None]))
        await asyncio.sleep(WAIT_BEFORE_PUT_S)
        begun = (await _run_operation(putter, "put", ["wake", number, 7]))["moments"][0]
        taken = await waiting
        if taken["good"]:
            took.append((taken["moments"][1] - begun) * 1000)
    return {**summarize(took), "lost": count - len(took), "of": count}


async def _measure_races(course: Workload) -> Result:
    """Let several nodes take one tuple at once; count the races with exactly one winner."""
    single = 0
    count = course.plan.scale_count(RACES)
    for number in range(count):
        putter, *takers = course.rng.sample(course.nodes, min(TAKERS + 1, len(course.nodes)))
        await _run_operation(putter, "put", ["race", number, 7])
        taken = await asyncio.gather(
            *(_run_operation(taker, "get_if_exists", ["race", number, None]) for taker in takers)
        )
        single += sum(each["good"] for each in taken) == 1
    return {"single_winner": single, "of": count}
