"""Read directly after the failure of a quarter of the nodes, and again after the failure of a half.

A killed node leaves a closed port, which is reported immediately on loopback, unlike in a real outage. A silent
(stopped) node does not answer, like a robot out of range or without power.
"""

from __future__ import annotations

import asyncio
import signal

from benchmarks.dht.workload import SINGLES_LIMIT_S, Workload, summarize

IN_FLIGHT = 10
LOSS_LIMIT_S = 30.0
WRITERS = 4
MIN_NODES = 8
"""Minimum number of nodes; half of a smaller network is too few for a meaningful result."""


async def measure_losses(workload: Workload, is_silent: bool) -> None:
    """Store, fail nodes, read; the figures are stored under the number of failed nodes."""
    nodes, plan = workload.nodes, workload.plan
    async with workload.phase("store", 180.0):
        await workload.start_nodes(nodes)
        items = [(f"loss {n}", workload.make_value()) for n in range(plan.keys)]
        parts = [
            workload.run_load(nodes[n], "put", items[n::WRITERS], 2, SINGLES_LIMIT_S, once=True) for n in range(WRITERS)
        ]
        done = {key for outcome in await asyncio.gather(*parts) for key in outcome["done"]}
        # Only values that the library reported as stored are counted as missing.
        stored = [item for item in items if item[0] in done]
        workload.result["stored"] = len(stored)
        await asyncio.sleep(plan.scale_pause(1.0))
    if "trouble" in workload.result:
        return
    step, half = len(nodes) // 4, len(stored) // 2
    victims = workload.rng.sample(nodes[WRITERS:], 2 * step)
    readers = workload.rng.sample([node for node in nodes[1:] if node not in victims], 2)
    for number, reader in enumerate(readers):
        for victim in victims[number * step : (number + 1) * step]:
            victim.send_signal(signal.SIGSTOP if is_silent else signal.SIGKILL)
        await asyncio.sleep(0.05)
        wanted = stored[number * half : (number + 1) * half]
        if not wanted:
            continue
        async with workload.phase(f"{(number + 1) * step} gone"):
            outcome = await workload.run_load(reader, "get", wanted, IN_FLIGHT, LOSS_LIMIT_S, once=True)
            workload.result["a half" if number else "a quarter"] = {
                "gone": (number + 1) * step,
                "wanted": len(wanted),
                "found_percent": 100 * outcome["good"] / len(wanted),
                **summarize(outcome["ms"]),
            }
