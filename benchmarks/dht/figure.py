"""The rows of the comparison, and the functions that read them from a result."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from benchmarks.dht.meter import percentile

Result = Mapping[str, Any]
Read = Callable[[Result], float | None]


def at(*path: str) -> Read:
    """Return a function that reads the number at ``path``."""

    def read(result: Result) -> float | None:
        found: Any = result
        for step in path:
            found = found.get(step) if isinstance(found, Mapping) else None
        return found if isinstance(found, int | float) else None

    return read


def percent(*path: str) -> Read:
    """Return a function that reads a share, in percent."""
    share = at(*path)

    def read(result: Result) -> float | None:
        found = share(result)
        return None if found is None else 100 * found

    return read


def joined(result: Result) -> float | None:
    """Return the median time to join, of the nodes that joined."""
    return percentile([ms for ms in result.get("join_ms", []) if ms is not None], 50)


def slowest(result: Result) -> float | None:
    """Return the longest successful operation, under load and losses included, in ms."""
    names = (("put",), ("get",), ("gets",), ("puts",), *((a, b) for a in LOSSES for b in PARTS))
    found = [ms for name in names if (ms := at(*name, "max")(result)) is not None]
    return max(found) if found else None


LOSSES = ("killed", "silent")
PARTS = ("a quarter", "a half")

ROWS: list[tuple[str, Read]] = [
    ("join, first old key read, ms", joined),
    ("put p50, ms", at("put", "p50")),
    ("put p95, ms", at("put", "p95")),
    ("get p50, ms", at("get", "p50")),
    ("get p95, ms", at("get", "p95")),
    ("remote get p50, ms", at("remote_get", "p50")),
    ("remote get p95, ms", at("remote_get", "p95")),
    ("local reads among the gets, %", percent("local_share")),
    ("gets/s, 32 in flight", at("gets", "per_s")),
    ("  their p95, ms", at("gets", "p95")),
    ("  local reads among them, %", percent("load_local_share")),
    ("puts/s, 32 in flight", at("puts", "per_s")),
    ("  their p95, ms", at("puts", "p95")),
    ("  failed", at("puts", "failed")),
    ("datagrams a put", at("put", "datagrams")),
    ("datagrams a get", at("get", "datagrams")),
    ("datagrams a remote get", at("remote_get", "datagrams")),
    ("CPU ms a put, all nodes", at("puts", "cpu_ms")),
    ("CPU ms a get, all nodes", at("gets", "cpu_ms")),
    ("RSS a node, MiB", at("rss_mib")),
    ("USS a node, MiB", at("uss_mib")),
    ("idle datagrams/s a node", at("idle", "datagrams_per_s")),
    ("idle core a node, %", at("idle", "core_percent")),
    ("watch p50, ms", at("watch", "p50")),
    ("watch p95, ms", at("watch", "p95")),
    ("watch, lost of 30", at("watch", "lost")),
    ("1 MiB put p50, ms", at("long", "put", "p50")),
    ("1 MiB get p50, ms", at("long", "get", "p50")),
    ("1 MiB put p50, 5 % lost, ms", at("long_lossy", "put", "p50")),
    ("1 MiB get p50, 5 % lost, ms", at("long_lossy", "get", "p50")),
    ("tuple put p50, ms", at("space", "put", "p50")),
    ("tuple put, datagrams", at("space", "put", "datagrams")),
    ("tuple read p50, ms", at("space", "read", "p50")),
    ("tuple take p50, ms", at("space", "take", "p50")),
    ("tuple take, datagrams", at("space", "take", "datagrams")),
    ("tuple wake-up p50, ms", at("space", "wake", "p50")),
    ("stored before the losses, of 200", at("silent", "stored")),
    *(
        (f"{part} {loss}: {what}", at(loss, part, field))
        for loss in LOSSES
        for part in PARTS
        for what, field in (("found, %", "found_percent"), ("p95, ms", "p95"), ("max, ms", "max"))
    ),
    ("slowest good operation, ms", slowest),
    ("datagrams dropped by the kernel", at("puts", "dropped")),
    ("taken by others, % of the machine", percent("gets", "foreign")),
]
