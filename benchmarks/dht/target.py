"""Target: what is wanted of this library, in figures of its own and of its peers in the same run.

Where the peer is not in the run (Entangled of 2011, libp2p) its figure on the machine of the first comparison stands
in; ``None`` as a verdict says that something that is needed was not measured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from benchmarks.dht.contestant import OURS, OURS_IN_MEMORY
from benchmarks.dht.figure import Read, Result, at, joined, slowest

ENTANGLED_JOIN_MS = 3.4
ENTANGLED_OUT_MS, ENTANGLED_OUT_DATAGRAMS = 190.0, 520.0
ENTANGLED_DURABLE_PUTS = 81.0
LIBP2P_LONG_MS = 92.0
SLOW_MS = 1000.0

Row = Mapping[str, Result]


class Limit(NamedTuple):
    """One figure that must not be above (``most``), or else not below, ``bound``."""

    what: str
    value: float | None
    bound: float | None
    most: bool = True

    @property
    def is_held(self) -> bool | None:
        """Whether it is; None where it is not known."""
        if self.value is None or self.bound is None:
            return None
        return self.value <= self.bound if self.most else self.value >= self.bound

    def __str__(self) -> str:
        value, bound = ("?" if v is None else f"{v:,.2f}" if v < 100 else f"{v:,.0f}" for v in (self.value, self.bound))
        return f"{self.what} {value} ({'at most' if self.most else 'at least'} {bound})"


class Verdict(NamedTuple):
    """What became of one target."""

    number: int
    title: str
    limits: list[Limit]

    @property
    def is_reached(self) -> bool | None:
        """No where any limit is missed, None where none is but some are not known."""
        held = [limit.is_held for limit in self.limits]
        return False if False in held else None if None in held else True


def verdicts(row: Row) -> list[Verdict]:
    """All fourteen, for the results of one size of network."""
    ours: Result = row.get(OURS) or row.get(OURS_IN_MEMORY) or {}

    def peer(read: Read, *names: str, factor: float, best: Callable[..., float] = min) -> float | None:
        found = [value for name in names if (value := read(row.get(name, {}))) is not None]
        return factor * best(found) if found else None

    torrent, opendht = "libtorrent-free", "opendht-free"
    remote, put, gets, puts = at("remote_get", "p50"), at("put", "p50"), at("gets", "per_s"), at("puts", "per_s")
    get_cpu, put_cpu, watch, long = (
        at("gets", "cpu_ms"),
        at("puts", "cpu_ms"),
        at("watch", "p50"),
        at("long", "put", "p50"),
    )
    in_memory = put(row.get(OURS_IN_MEMORY, {}))
    race, wake = ours.get("space", {}).get("race", {}), at("space", "wake", "lost")
    gone = [(loss, part) for loss in ("killed", "silent") for part in ("a quarter", "a half")]
    failed = sum(ours[name]["failed"] for name in ("put", "get", "gets", "puts") if name in ours)
    nothing_done = [
        name for name in ("put", "get", "gets", "puts") if name in ours and ours[name]["tried"] == ours[name]["failed"]
    ] + [name for name in ("silent", "killed") if "trouble" in ours.get(name, {})]
    lost = [v for g in gone if (v := at(*g, "found_percent")(ours)) is not None]
    kept = min(lost) if len(lost) == len(gone) else None
    return [
        Verdict(1, "remote get", [Limit("p50 ms", remote(ours), peer(remote, torrent, factor=0.9))]),
        Verdict(2, "put, a majority acked", [Limit("p50 ms", put(ours), peer(put, torrent, opendht, factor=0.9))]),
        Verdict(3, "gets/s", [Limit("gets/s", gets(ours), peer(gets, torrent, factor=1.2), most=False)]),
        Verdict(4, "puts/s", [Limit("puts/s", puts(ours), peer(puts, opendht, factor=1.4), most=False)]),
        Verdict(
            5,
            "datagrams",
            [
                Limit("a remote get", at("remote_get", "datagrams")(ours), 3.0),
                Limit("a put", at("put", "datagrams")(ours), 18.0),
            ],
        ),
        Verdict(
            6,
            "CPU of all nodes",
            [
                Limit("ms a get", get_cpu(ours), peer(get_cpu, torrent, factor=0.8)),
                Limit("ms a put", put_cpu(ours), peer(put_cpu, opendht, factor=0.8)),
            ],
        ),
        Verdict(7, "join (Entangled 2011)", [Limit("ms", joined(ours), ENTANGLED_JOIN_MS)]),
        Verdict(
            8,
            "a half silent",
            [
                Limit("found %", at("silent", "a half", "found_percent")(ours), 100.0, most=False),
                Limit("p95 ms", at("silent", "a half", "p95")(ours), 20.0),
                Limit("max ms", at("silent", "a half", "max")(ours), 60.0),
            ],
        ),
        Verdict(
            9,
            "always done, within 1 s",
            [
                Limit("phases with nothing done", float(len(nothing_done)) if ours else None, 0.0),
                Limit("operations failed", float(failed) if ours else None, 0.0),
                Limit("found % after losses", kept, 100.0, most=False),
                Limit("slowest ms", slowest(ours), SLOW_MS),
            ],
        ),
        Verdict(
            10,
            "watch",
            [
                Limit("p50 ms", watch(ours), peer(watch, opendht, factor=0.8)),
                Limit("lost", at("watch", "lost")(ours), 0.0),
            ],
        ),
        Verdict(
            11,
            "tuple put (Entangled 2011)",
            [
                Limit("p50 ms", at("space", "put", "p50")(ours), ENTANGLED_OUT_MS / 35),
                Limit("datagrams", at("space", "put", "datagrams")(ours), ENTANGLED_OUT_DATAGRAMS / 10),
            ],
        ),
        Verdict(
            12,
            "tuples are there, taken once",
            [
                Limit("found %", at("space", "crowd", "found_percent")(ours), 100.0, most=False),
                Limit("races with one winner", race.get("single_winner"), race.get("of"), most=False),
                Limit("wake-ups lost", wake(ours), 0.0),
            ],
        ),
        Verdict(
            13,
            "1 MiB (libp2p)",
            [
                Limit("put p50 ms", long(ours), LIBP2P_LONG_MS),
                Limit("failed at 5 % loss", at("long_lossy", "failed")(ours), 0.0),
            ],
        ),
        Verdict(
            14,
            "durable put",
            [
                Limit("p50 ms", put(ours), None if in_memory is None else 1.2 * in_memory),
                Limit("puts/s", puts(row.get(OURS, {})), 20 * ENTANGLED_DURABLE_PUTS, most=False),
            ],
        ),
    ]
