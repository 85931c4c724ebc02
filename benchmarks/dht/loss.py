"""Read directly after the failure of a quarter of the nodes, and again after the failure of a half.

A killed node leaves a closed port, which loopback reports at once, unlike a real outage; a silent (stopped) node does
not answer, like a robot out of range or without power.
"""

from __future__ import annotations

import asyncio
import signal

from benchmarks.dht.workload import SINGLES_LIMIT_S, Workload, summarize

IN_FLIGHT = 10
LOSS_LIMIT_S = 30.0
WRITERS = 4
MIN_NODES = 8
"""In a smaller network half of the nodes is too few for a meaningful result."""


async def measure_losses(course: Workload, is_silent: bool) -> None:
    """Store, fail nodes, read; the figures are stored under the number of failed nodes."""
    nodes, plan = course.nodes, course.plan
    async with course.phase("store", 180.0):
        await course.start_nodes(nodes)
        items = [(f"loss {n}", course.make_value()) for n in range(plan.keys)]
        parts = [
            course.run_load(nodes[n], "put", items[n::WRITERS], 2, SINGLES_LIMIT_S, once=True) for n in range(WRITERS)
        ]
        done = {key for outcome in await asyncio.gather(*parts) for key in outcome["done"]}
        # Only values that the library reported as stored can count as missing.
        stored = [item for item in items if item[0] in done]
        course.result["stored"] = len(stored)
        await asyncio.sleep(plan.scale_pause(1.0))
    if "trouble" in course.result:
        return
    step, half = len(nodes) // 4, len(stored) // 2
    victims = course.rng.sample(nodes[WRITERS:], 2 * step)
    readers = course.rng.sample([node for node in nodes[1:] if node not in victims], 2)
    for number, reader in enumerate(readers):
        for victim in victims[number * step : (number + 1) * step]:
            victim.send_signal(signal.SIGSTOP if is_silent else signal.SIGKILL)
        await asyncio.sleep(0.05)
        wanted = stored[number * half : (number + 1) * half]
        if not wanted:
            continue
        async with course.phase(f"{(number + 1) * step} gone"):
            outcome = await course.run_load(reader, "get", wanted, IN_FLIGHT, LOSS_LIMIT_S, once=True)
            course.result["a half" if number else "a quarter"] = {
                "gone": (number + 1) * step,
                "wanted": len(wanted),
                "found_percent": 100 * outcome["good"] / len(wanted),
                **summarize(outcome["ms"]),
            }
