"""Measure the operations that only some libraries have: long values and watches."""

from __future__ import annotations

import asyncio
import time

from benchmarks.dht.contestant import MIB
from benchmarks.dht.course import Course, Result, times

LONG_VALUES = 5
LONG_S = 10.0
LOSS = 0.05
WATCHES = 30
HEARD_S = 2.0


async def long_values(course: Course) -> None:
    """Put and get 1 MiB, also with datagram loss at every node, if the library supports it."""
    entry, nodes = course.team.entry, course.nodes
    if entry.largest < MIB:
        return
    async with course.phase("1 MiB"):
        course.result["long"] = await _long(course, "long")
        if "lose" in entry.can:
            for node in nodes:
                await node.order("lose", share=LOSS)
            course.result["long_lossy"] = await _long(course, "long and lossy")
    if "lose" in entry.can:
        for node in nodes:
            await node.order("lose", share=0.0)


async def _long(course: Course, name: str) -> Result:
    puts, gets, failed = [], [], 0
    for number in range(LONG_VALUES):
        writer, reader = course.rng.sample(course.nodes, 2)
        put = await course.once(writer, "put", f"{name} {number}", MIB, LONG_S)
        get = await course.once(reader, "get", f"{name} {number}", MIB, LONG_S) if put["good"] else put
        if not (put["good"] and get["good"]):
            failed += 1
            break
        puts.append(put["ms"])
        gets.append(get["ms"])
    return {"put": times(puts), "get": times(gets), "failed": failed}


async def watches(course: Course) -> None:
    """Measure the time from the start of a put until a watcher at another node has the value."""
    if "watch" not in course.team.entry.can:
        return
    took: list[float] = []
    async with course.phase("watch", 120.0):
        await asyncio.sleep(course.plan.pause(1.0))
        count = course.plan.share(WATCHES)
        for number in range(count):
            writer, watcher = course.rng.sample(course.nodes, 2)
            key, value = f"watched {number}", course.value()
            await watcher.order("watch", key=key, value=value)
            begun = (await course.once(writer, "put", key, value))["moment"]
            ends_at = time.monotonic() + HEARD_S
            moments: list[float] = []
            while not moments and time.monotonic() < ends_at:
                await asyncio.sleep(0.02)
                moments = (await watcher.order("heard", key=key))["moments"]
            took += [(moment - begun) * 1000 for moment in moments[:1]]
        course.result["watch"] = {**times(took), "lost": count - len(took), "of": count}
