"""Kernel counters: processor time, memory, datagrams. Linux only: the figures come from ``/proc``."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from benchmarks.measure import TICKS_PER_S, read_maps_mib, read_udp_counter


def percentile(values: list[float], percent: float) -> float | None:
    """Return the value below which ``percent`` of ``values`` lie (nearest rank); None for no values."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, round(percent / 100 * (len(ordered) - 1)))] if ordered else None


def read_cpu_s(pids: Iterable[int]) -> float:
    """Return the processor seconds of the threads of these processes, except for threads that have ended."""
    total = 0
    for pid in pids:
        for file in Path(f"/proc/{pid}/task").glob("*/schedstat"):
            try:
                total += int(file.read_text().split()[0])
            except OSError:
                continue
    return total / 1e9


def read_memory_mib(pid: int) -> tuple[float, float]:
    """Return the resident memory of a process, and its private part (RSS, USS)."""
    mib = read_maps_mib(pid)
    return mib["Rss"], mib["Private_Clean"] + mib["Private_Dirty"]


def read_busy_s() -> float:
    """Return the busy seconds of all processors together."""
    fields = [int(field) for field in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
    return (sum(fields) - fields[3] - fields[4]) / TICKS_PER_S


@dataclass
class Cost:
    """The resources of a phase; ``foreign`` is the share of the machine that other processes used."""

    seconds: float = 1.0
    cpu_s: float = 0.0
    datagrams: float = 0.0
    dropped: float = 0.0
    foreign_share: float = 0.0

    def per_operation(self, operations: int, idle: Cost) -> dict[str, float]:
        """Return the cost of one operation, after subtracting the cost of an idle network in the same time."""
        noise = {"dropped": self.dropped, "foreign": self.foreign_share}
        if not operations:
            return noise
        share = self.seconds / idle.seconds
        return {
            "cpu_ms": max(0.0, self.cpu_s - idle.cpu_s * share) * 1000 / operations,
            "datagrams": max(0.0, self.datagrams - idle.datagrams * share) / operations,
            **noise,
        }


class Meter:
    """Count from creation to ``read``."""

    def __init__(self, pids: list[int]) -> None:
        self._pids = pids
        self._start = self._read_counters()

    def read(self) -> Cost:
        """Return the cost since the creation."""
        seconds, cpu, own, sent, dropped, busy = (
            b - a for a, b in zip(self._start, self._read_counters(), strict=True)
        )
        foreign = (busy - cpu - own) / seconds / (os.cpu_count() or 1)
        return Cost(seconds, cpu, sent, dropped, max(0.0, foreign))

    def _read_counters(self) -> tuple[float, ...]:
        sent, dropped = read_udp_counter("OutDatagrams"), read_udp_counter("RcvbufErrors")
        return time.monotonic(), read_cpu_s(self._pids), time.process_time(), float(sent), float(dropped), read_busy_s()
