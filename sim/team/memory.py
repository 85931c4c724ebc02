"""Memory: what a team will need and what the machine has, so that a run that cannot end is not begun."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress

from middleware.errors import BadSetting
from sim.team.scenario import Scenario

KIB = {"entangled": 250, "swarm": 1000}
"""KiB of a node, rounded up from what was measured: 231 for one of 1,000 peers of the network alone; 937 for one of
120 whole nodes of devices, each of which reads the whole directory when it comes."""
BASE = 60 * 2**20
"""Bytes of the interpreter and all modules."""
SPARED = 0.9
"""Share of what is free that a run may take."""
GROUPS = "/proc/self/cgroup"
V2, V1 = "/sys/fs/cgroup", "/sys/fs/cgroup/memory"
NO_LIMIT = 2**60

Read = Callable[[str], str]
"""The text of a file; raises ``OSError``."""


def foreseen(scenario: Scenario) -> int:
    """Bytes that the team of a scenario will need."""
    newcomers = sum(fault.count for fault in scenario.faults if fault.kind == "crowd")
    return BASE + (scenario.nodes + newcomers) * KIB[scenario.kind] * 1024


def free(read: Read) -> int:
    """Bytes that this process may still take: what the machine has, or what its groups of processes leave it."""
    found = [NO_LIMIT, *_group_limits(read)]
    with suppress(OSError, ValueError, IndexError):
        line = next(line for line in read("/proc/meminfo").splitlines() if line.startswith("MemAvailable:"))
        found.append(int(line.split()[1]) * 1024)
    return min(found)


def resident(read: Read) -> int:
    """Bytes that this process has; 0 where the system does not tell."""
    with suppress(OSError, ValueError, StopIteration):
        line = next(line for line in read("/proc/self/status").splitlines() if line.startswith("VmRSS:"))
        return int(line.split()[1]) * 1024
    return 0


def check(scenario: Scenario, read: Read) -> None:
    """Raise ``BadSetting`` where the team of a scenario does not fit."""
    needed, left = foreseen(scenario), free(read)
    if needed <= left * SPARED:
        return
    fit = max(0, int((left * SPARED - BASE) / (KIB[scenario.kind] * 1024)))
    problem = f"{scenario.nodes:,} nodes need {_size(needed)} of memory, and {_size(int(left * SPARED))} can be had"
    raise BadSetting("command line", "--nodes", problem, f"take at most {fit:,}, or a machine with more")


def _group_limits(read: Read) -> Iterator[int]:
    """What each group of processes that this one is in has left."""
    try:
        lines = read(GROUPS).splitlines()
    except OSError:
        return
    for line in lines:
        _, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if controllers == "":
            root, most, used = V2, "memory.max", "memory.current"
        elif "memory" in controllers.split(","):
            root, most, used = V1, "memory.limit_in_bytes", "memory.usage_in_bytes"
        else:
            continue
        parts = [part for part in path.split("/") if part and part != ".."]
        for depth in range(len(parts), -1, -1):
            folder = "/".join([root, *parts[:depth]])
            with suppress(OSError, ValueError):  # "max" is no number
                yield max(0, int(read(f"{folder}/{most}")) - int(read(f"{folder}/{used}")))


def _size(number: int) -> str:
    return f"{number / 2**30:.1f} GiB" if number >= 2**30 else f"{number / 2**20:.0f} MiB"
