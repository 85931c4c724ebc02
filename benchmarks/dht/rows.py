"""The rows of the comparison, and the functions that read them from a result."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from benchmarks.dht.meter import percentile

Result = Mapping[str, Any]
Reader = Callable[[Result], float | None]


def make_reader(*path: str) -> Reader:
    """Return a function that reads the number at ``path``."""

    def read(result: Result) -> float | None:
        found: Any = result
        for step in path:
            found = found.get(step) if isinstance(found, Mapping) else None
        return found if isinstance(found, int | float) else None

    return read


def make_percent_reader(*path: str) -> Reader:
    """Return a function that reads a share, in percent."""
    share = make_reader(*path)

    def read(result: Result) -> float | None:
        found = share(result)
        return None if found is None else 100 * found

    return read


def read_join_ms(result: Result) -> float | None:
    """Return the median time to join, of the nodes that joined."""
    return percentile([ms for ms in result.get("join_ms", []) if ms is not None], 50)


def read_slowest_ms(result: Result) -> float | None:
    """Return the duration of the longest successful operation in ms, also under load and after node failures."""
    names = (("put",), ("get",), ("gets",), ("puts",), *((a, b) for a in LOSSES for b in FAILED_PARTS))
    found = [ms for name in names if (ms := make_reader(*name, "max")(result)) is not None]
    return max(found) if found else None


LOSSES = ("killed", "silent")
FAILED_PARTS = ("a quarter", "a half")

ROWS: list[tuple[str, Reader]] = [
    ("join, first old key read, ms", read_join_ms),
    ("put p50, ms", make_reader("put", "p50")),
    ("put p95, ms", make_reader("put", "p95")),
    ("get p50, ms", make_reader("get", "p50")),
    ("get p95, ms", make_reader("get", "p95")),
    ("remote get p50, ms", make_reader("remote_get", "p50")),
    ("remote get p95, ms", make_reader("remote_get", "p95")),
    ("local reads among the gets, %", make_percent_reader("local_share")),
    ("gets/s, 32 in flight", make_reader("gets", "per_s")),
    ("  their p95, ms", make_reader("gets", "p95")),
    ("  local reads among them, %", make_percent_reader("load_local_share")),
    ("puts/s, 32 in flight", make_reader("puts", "per_s")),
    ("  their p95, ms", make_reader("puts", "p95")),
    ("  failed", make_reader("puts", "failed")),
    ("datagrams a put", make_reader("put", "datagrams")),
    ("datagrams a get", make_reader("get", "datagrams")),
    ("datagrams a remote get", make_reader("remote_get", "datagrams")),
    ("CPU ms a put, all nodes", make_reader("puts", "cpu_ms")),
    ("CPU ms a get, all nodes", make_reader("gets", "cpu_ms")),
    ("RSS a node, MiB", make_reader("rss_mib")),
    ("USS a node, MiB", make_reader("uss_mib")),
    ("idle datagrams/s a node", make_reader("idle", "datagrams_per_s")),
    ("idle core a node, %", make_reader("idle", "core_percent")),
    ("watch p50, ms", make_reader("watch", "p50")),
    ("watch p95, ms", make_reader("watch", "p95")),
    ("watch, lost of 30", make_reader("watch", "lost")),
    ("1 MiB put p50, ms", make_reader("long", "put", "p50")),
    ("1 MiB get p50, ms", make_reader("long", "get", "p50")),
    ("1 MiB put p50, 5 % lost, ms", make_reader("long_lossy", "put", "p50")),
    ("1 MiB get p50, 5 % lost, ms", make_reader("long_lossy", "get", "p50")),
    ("tuple put p50, ms", make_reader("space", "put", "p50")),
    ("tuple put, datagrams", make_reader("space", "put", "datagrams")),
    ("tuple read p50, ms", make_reader("space", "read", "p50")),
    ("tuple take p50, ms", make_reader("space", "take", "p50")),
    ("tuple take, datagrams", make_reader("space", "take", "datagrams")),
    ("tuple wake-up p50, ms", make_reader("space", "wake", "p50")),
    ("stored before the losses, of 200", make_reader("silent", "stored")),
    *(
        (f"{part} {loss}: {what}", make_reader(loss, part, field))
        for loss in LOSSES
        for part in FAILED_PARTS
        for what, field in (("found, %", "found_percent"), ("p95, ms", "p95"), ("max, ms", "max"))
    ),
    ("slowest good operation, ms", read_slowest_ms),
    ("datagrams dropped by the kernel", make_reader("puts", "dropped")),
    ("taken by others, % of the machine", make_percent_reader("gets", "foreign")),
]
