"""Targets for this library, as absolute figures or relative to other libraries in the same run.

If a library is not in the run (Entangled of 2011, libp2p), its figure from the first comparison is used; the verdict
``None`` means that a required figure was not measured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from benchmarks.dht.contestant import OURS, OURS_IN_MEMORY
from benchmarks.dht.figure import LOSSES, PARTS, Read, Result, at, joined, slowest

ENTANGLED_JOIN_MS = 3.4
ENTANGLED_OUT_MS, ENTANGLED_OUT_DATAGRAMS = 190.0, 520.0
ENTANGLED_DURABLE_PUTS = 81.0
LIBP2P_LONG_MS = 92.0
SLOW_MS = 1000.0

TORRENT, OPENDHT = "libtorrent-free", "opendht-free"
OPERATIONS = ("put", "get", "gets", "puts")

Row = Mapping[str, Result]
"""The results of one network size, by library."""
Figure = Callable[[Row], float | None]


class Limit(NamedTuple):
    """A figure that must not be above (``most``) or below ``bound``."""

    what: str
    value: float | None
    bound: float | None
    most: bool = True

    @property
    def is_held(self) -> bool | None:
        """Return whether it meets the limit; None if it is unknown."""
        if self.value is None or self.bound is None:
            return None
        return self.value <= self.bound if self.most else self.value >= self.bound

    def __str__(self) -> str:
        value, bound = ("?" if v is None else f"{v:,.2f}" if v < 100 else f"{v:,.0f}" for v in (self.value, self.bound))
        return f"{self.what} {value} ({'at most' if self.most else 'at least'} {bound})"


class Verdict(NamedTuple):
    """The result of one target."""

    number: int
    title: str
    limits: list[Limit]

    @property
    def is_reached(self) -> bool | None:
        """False if any limit is missed, None if none is missed but some are unknown."""
        held = [limit.is_held for limit in self.limits]
        return False if False in held else None if None in held else True


class Wanted(NamedTuple):
    """A figure of a row with the bound that it must not be above (``most``) or below."""

    what: str
    figure: Figure
    bound: Figure | float
    most: bool = True

    def limit(self, row: Row) -> Limit:
        """Return the limit with the figures of ``row``."""
        bound = self.bound if isinstance(self.bound, float) else self.bound(row)
        return Limit(self.what, self.figure(row), bound, self.most)


class Target(NamedTuple):
    """A title, and all limits that belong to it."""

    title: str
    wanted: tuple[Wanted, ...]


# -- sources of the figures ----------------------------------------------------------------------------------------


def own(row: Row) -> Result:
    """Return the results of this library in ``row``: with SQLite, otherwise in memory."""
    return row.get(OURS) or row.get(OURS_IN_MEMORY) or {}


def ours(read: Read) -> Figure:
    """Return a reader of ``read`` in the results of this library."""
    return lambda row: read(own(row))


def peer(read: Read, *names: str, factor: float) -> Figure:
    """Return ``factor`` times the least figure that ``read`` finds in the results of the libraries ``names``."""

    def least(row: Row) -> float | None:
        found = [value for name in names if (value := read(row.get(name, {}))) is not None]
        return factor * min(found) if found else None

    return least


def idle_phases(result: Result) -> float | None:
    """Return the number of phases without results: every operation failed, or the failures could not be tested."""
    idle = [name for name in OPERATIONS if name in result and result[name]["tried"] == result[name]["failed"]]
    stuck = [loss for loss in LOSSES if "trouble" in result.get(loss, {})]
    return float(len(idle) + len(stuck)) if result else None


def failed(result: Result) -> float | None:
    """Return the number of failed operations while all nodes were healthy."""
    return float(sum(result[name]["failed"] for name in OPERATIONS if name in result)) if result else None


def found_after_losses(result: Result) -> float | None:
    """Return the least share of keys found after any failure, in percent; None if not all were tested."""
    found = [at(loss, part, "found_percent")(result) for loss in LOSSES for part in PARTS]
    known = [value for value in found if value is not None]
    return min(known) if len(known) == len(found) else None


# -- the targets ----------------------------------------------------------------------------------------------------

_REMOTE, _PUT, _GETS, _PUTS = at("remote_get", "p50"), at("put", "p50"), at("gets", "per_s"), at("puts", "per_s")
_GET_CPU, _PUT_CPU, _WATCH = at("gets", "cpu_ms"), at("puts", "cpu_ms"), at("watch", "p50")

TARGETS = (
    Target("remote get", (Wanted("p50 ms", ours(_REMOTE), peer(_REMOTE, TORRENT, factor=0.9)),)),
    Target("put, a majority acked", (Wanted("p50 ms", ours(_PUT), peer(_PUT, TORRENT, OPENDHT, factor=0.9)),)),
    Target("gets/s", (Wanted("gets/s", ours(_GETS), peer(_GETS, TORRENT, factor=1.2), most=False),)),
    Target("puts/s", (Wanted("puts/s", ours(_PUTS), peer(_PUTS, OPENDHT, factor=1.4), most=False),)),
    Target(
        "datagrams",
        (
            Wanted("a remote get", ours(at("remote_get", "datagrams")), 3.0),
            Wanted("a put", ours(at("put", "datagrams")), 18.0),
        ),
    ),
    Target(
        "CPU of all nodes",
        (
            Wanted("ms a get", ours(_GET_CPU), peer(_GET_CPU, TORRENT, factor=0.8)),
            Wanted("ms a put", ours(_PUT_CPU), peer(_PUT_CPU, OPENDHT, factor=0.8)),
        ),
    ),
    Target("join (Entangled 2011)", (Wanted("ms", ours(joined), ENTANGLED_JOIN_MS),)),
    Target(
        "a half silent",
        (
            Wanted("found %", ours(at("silent", "a half", "found_percent")), 100.0, most=False),
            Wanted("p95 ms", ours(at("silent", "a half", "p95")), 20.0),
            Wanted("max ms", ours(at("silent", "a half", "max")), 60.0),
        ),
    ),
    Target(
        "always done, within 1 s",
        (
            Wanted("phases with nothing done", ours(idle_phases), 0.0),
            Wanted("operations failed", ours(failed), 0.0),
            Wanted("found % after losses", ours(found_after_losses), 100.0, most=False),
            Wanted("slowest ms", ours(slowest), SLOW_MS),
        ),
    ),
    Target(
        "watch",
        (
            Wanted("p50 ms", ours(_WATCH), peer(_WATCH, OPENDHT, factor=0.8)),
            Wanted("lost", ours(at("watch", "lost")), 0.0),
        ),
    ),
    Target(
        "tuple put (Entangled 2011)",
        (
            Wanted("p50 ms", ours(at("space", "put", "p50")), ENTANGLED_OUT_MS / 35),
            Wanted("datagrams", ours(at("space", "put", "datagrams")), ENTANGLED_OUT_DATAGRAMS / 10),
        ),
    ),
    Target(
        "tuples are there, taken once",
        (
            Wanted("found %", ours(at("space", "crowd", "found_percent")), 100.0, most=False),
            Wanted(
                "races with one winner",
                ours(at("space", "race", "single_winner")),
                ours(at("space", "race", "of")),
                most=False,
            ),
            Wanted("wake-ups lost", ours(at("space", "wake", "lost")), 0.0),
        ),
    ),
    Target(
        "1 MiB (libp2p)",
        (
            Wanted("put p50 ms", ours(at("long", "put", "p50")), LIBP2P_LONG_MS),
            Wanted("failed at 5 % loss", ours(at("long_lossy", "failed")), 0.0),
        ),
    ),
    Target(
        "durable put",
        (
            Wanted("p50 ms", ours(_PUT), peer(_PUT, OURS_IN_MEMORY, factor=1.2)),
            Wanted("puts/s", peer(_PUTS, OURS, factor=1.0), 20 * ENTANGLED_DURABLE_PUTS, most=False),
        ),
    ),
)


def verdicts(row: Row) -> list[Verdict]:
    """Return the results of all fourteen targets for one network size."""
    return [
        Verdict(number, target.title, [wanted.limit(row) for wanted in target.wanted])
        for number, target in enumerate(TARGETS, 1)
    ]
