"""Common tools: percentiles, child processes that report in JSON, and figures of ``/proc`` (Linux)."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

MIB = 2**20
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


def percentile(values: Sequence[float], share: float) -> float:
    """Return the value below which that share of ``values`` lies; infinity for no values."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else math.inf


def read_cpu_s(pid: int) -> float:
    """Return the processor seconds of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


def read_memory_bytes(field: str = "VmRSS", pid: int | str = "self") -> int:
    """Return the memory of a process in bytes: resident now (``VmRSS``), or the maximum (``VmHWM``)."""
    lines = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines())
    return int(lines[field].split()[0]) * 1024


def read_maps_mib(pid: int) -> dict[str, float]:
    """Return the memory of a process in MiB by kind: ``Rss``, ``Pss``, ``Private_Clean`` and others."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
    return {line.split(":")[0]: float(line.split()[1]) / 1024 for line in lines if line.endswith("kB")}


def read_udp_counter(name: str) -> int:
    """Return a UDP counter of this machine, such as ``InDatagrams``, which counts the datagrams of all processes.

    In a separate network namespace (``benchmarks/README.md``) it counts only the nodes.
    """
    rows = [line.split() for line in Path("/proc/net/snmp").read_text().splitlines() if line.startswith("Udp:")]
    return int(rows[1][rows[0].index(name)])


class ChildProcess:
    """A child process that answers requests in lines of JSON."""

    def __init__(self, module: str, *arguments: object) -> None:
        command = [sys.executable, "-m", module, *map(str, arguments)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def read(self) -> dict[str, Any]:
        """Return the next line."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError("a child process exited early; its error output has the reason")
        found: dict[str, Any] = json.loads(line)
        return found

    def write(self, what: str = "") -> None:
        """Write a line."""
        assert self.process.stdin is not None
        self.process.stdin.write(what + "\n")
        self.process.stdin.flush()

    def request_report(self) -> dict[str, Any]:
        """Request and return a report."""
        self.write()
        return self.read()

    def end(self) -> None:
        """Close its input, and wait until it has exited."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        try:
            self.process.wait(15.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
