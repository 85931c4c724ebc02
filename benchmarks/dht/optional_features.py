"""Measure the operations that only some libraries have: long values and watches."""

from __future__ import annotations

import asyncio
import time

from benchmarks.dht.library import MIB
from benchmarks.dht.workload import Result, Workload, summarize

LONG_VALUES = 5
LONG_LIMIT_S = 10.0
LOSS_SHARE = 0.05
WATCHES = 30
NOTIFICATION_LIMIT_S = 2.0


async def measure_long_values(workload: Workload) -> None:
    """Put and get 1 MiB, also with datagram loss at every node, if the library supports it."""
    entry, nodes = workload.team.library, workload.nodes
    if entry.largest < MIB:
        return
    async with workload.phase("1 MiB"):
        workload.result["long"] = await _measure_long(workload, "long")
        if "lose" in entry.features:
            for node in nodes:
                await node.run_order("lose", share=LOSS_SHARE)
            workload.result["long_lossy"] = await _measure_long(workload, "long and lossy")
    if "lose" in entry.features:
        for node in nodes:
            await node.run_order("lose", share=0.0)


async def _measure_long(workload: Workload, name: str) -> Result:
    puts, gets, failed = [], [], 0
    for number in range(LONG_VALUES):
        writer, reader = workload.rng.sample(workload.nodes, 2)
        put = await workload.run_operation(writer, "put", f"{name} {number}", MIB, LONG_LIMIT_S)
        get = await workload.run_operation(reader, "get", f"{name} {number}", MIB, LONG_LIMIT_S) if put["good"] else put
        if not (put["good"] and get["good"]):
            failed += 1
            break
        puts.append(put["ms"])
        gets.append(get["ms"])
    return {"put": summarize(puts), "get": summarize(gets), "failed": failed}


async def measure_watches(workload: Workload) -> None:
    """Measure the time from the start of a put until a watcher at another node has the value."""
    if "watch" not in workload.team.library.features:
        return
    took: list[float] = []
    async with workload.phase("watch", 120.0):
        await asyncio.sleep(workload.plan.scale_pause(1.0))
        count = workload.plan.scale_count(WATCHES)
        for number in range(count):
            writer, watcher = workload.rng.sample(workload.nodes, 2)
            key, value = f"watched {number}", workload.make_value()
            await watcher.run_order("watch", key=key, value=value)
            begun = (await workload.run_operation(writer, "put", key, value))["moment"]
            ends_at = time.monotonic() + NOTIFICATION_LIMIT_S
            moments: list[float] = []
            while not moments and time.monotonic() < ends_at:
                await asyncio.sleep(0.02)
                moments = (await watcher.run_order("heard", key=key))["moments"]
            took += [(moment - begun) * 1000 for moment in moments[:1]]
        workload.result["watch"] = {**summarize(took), "lost": count - len(took), "of": count}
