"""Estimate the memory of a team, to refuse a run that does not fit into the free memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress

from middleware.errors import BadSetting
from sim.team.scenario import Scenario

KIB_PER_NODE = {"entangled": 250, "swarm": 1000}
"""KiB per node by kind, rounded up from measurements: 231 KiB in a team of 1,000 peers of the library; 937 KiB in a
team of 120 complete device nodes, each of which reads the whole directory when it joins."""
BASE_BYTES = 60 * 2**20
"""Memory of the interpreter and all modules in bytes."""
USABLE_SHARE = 0.9
"""Share of the free memory that a run may use."""
CGROUPS_FILE = "/proc/self/cgroup"
V2, V1 = "/sys/fs/cgroup", "/sys/fs/cgroup/memory"
NO_LIMIT_BYTES = 2**60

Read = Callable[[str], str]
"""Returns the text of a file; raises ``OSError``."""


def estimate_bytes(scenario: Scenario) -> int:
    """Return the estimated memory of a scenario's team in bytes."""
    newcomers = sum(fault.count for fault in scenario.faults if fault.kind == "crowd")
    return BASE_BYTES + (scenario.nodes + newcomers) * KIB_PER_NODE[scenario.kind] * 1024


def measure_free_bytes(read: Read) -> int:
    """Return the bytes that this process can still allocate: the machine's free memory or a limit of its cgroups."""
    found = [NO_LIMIT_BYTES, *_group_limits(read)]
    with suppress(OSError, ValueError, IndexError):
        line = next(line for line in read("/proc/meminfo").splitlines() if line.startswith("MemAvailable:"))
        found.append(int(line.split()[1]) * 1024)
    return min(found)


def measure_resident_bytes(read: Read) -> int:
    """Return the resident memory of this process in bytes; 0 if the system does not report it."""
    with suppress(OSError, ValueError, StopIteration):
        line = next(line for line in read("/proc/self/status").splitlines() if line.startswith("VmRSS:"))
        return int(line.split()[1]) * 1024
    return 0


def check_memory(scenario: Scenario, read: Read) -> None:
    """Raise ``BadSetting`` if the team of a scenario does not fit into memory."""
    needed, left = estimate_bytes(scenario), measure_free_bytes(read)
    if needed <= left * USABLE_SHARE:
        return
    fit = max(0, int((left * USABLE_SHARE - BASE_BYTES) / (KIB_PER_NODE[scenario.kind] * 1024)))
    available = _format_size(int(left * USABLE_SHARE))
    problem = f"{scenario.nodes:,} nodes need {_format_size(needed)} of memory, but {available} are available"
    raise BadSetting("command line", "--nodes", problem, f"use at most {fit:,}, or a machine with more memory")


def _group_limits(read: Read) -> Iterator[int]:
    """Yield the free memory of each cgroup of this process."""
    try:
        lines = read(CGROUPS_FILE).splitlines()
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
            with suppress(OSError, ValueError):  # "max" is not a number
                yield max(0, int(read(f"{folder}/{most}")) - int(read(f"{folder}/{used}")))


def _format_size(number: int) -> str:
    return f"{number / 2**30:.1f} GiB" if number >= 2**30 else f"{number / 2**20:.0f} MiB"
