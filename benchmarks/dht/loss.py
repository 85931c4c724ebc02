"""Loss: reads at once after a quarter of the nodes is gone, and again after half of them is.

Killed nodes leave a closed port behind, and loopback tells so, which no real outage does; silent ones (stopped) just
answer no more, as a robot out of range or out of battery.
"""

from __future__ import annotations

import asyncio
import signal

from benchmarks.dht.course import SINGLE_S, Course, times

IN_FLIGHT = 10
LOSS_S = 30.0
WRITERS = 4
LEAST = 8
"""With fewer nodes half of them is too few to speak of."""


async def lost(course: Course, is_silent: bool) -> None:
    """Store, lose, read; the figures stand under the number of nodes that are gone."""
    nodes, plan = course.nodes, course.plan
    async with course.phase("store", 180.0):
        await course.begin(nodes)
        items = [(f"loss {n}", course.value()) for n in range(plan.keys)]
        parts = [course.loaded(nodes[n], "put", items[n::WRITERS], 2, SINGLE_S, once=True) for n in range(WRITERS)]
        done = {key for outcome in await asyncio.gather(*parts) for key in outcome["done"]}
        # Only what the library called stored may be missed afterwards, not what it never came to.
        stored = [item for item in items if item[0] in done]
        course.result["stored"] = len(stored)
        await asyncio.sleep(plan.pause(1.0))
    if "trouble" in course.result:
        return
    step, half = len(nodes) // 4, len(stored) // 2
    victims = course.rng.sample(nodes[WRITERS:], 2 * step)
    readers = course.rng.sample([node for node in nodes[1:] if node not in victims], 2)
    for number, reader in enumerate(readers):
        for victim in victims[number * step : (number + 1) * step]:
            victim.send(signal.SIGSTOP if is_silent else signal.SIGKILL)
        await asyncio.sleep(0.05)
        wanted = stored[number * half : (number + 1) * half]
        if not wanted:
            continue
        async with course.phase(f"{(number + 1) * step} gone"):
            outcome = await course.loaded(reader, "get", wanted, IN_FLIGHT, LOSS_S, once=True)
            course.result["a half" if number else "a quarter"] = {
                "gone": (number + 1) * step,
                "wanted": len(wanted),
                "found_percent": 100 * outcome["good"] / len(wanted),
                **times(outcome["ms"]),
            }
