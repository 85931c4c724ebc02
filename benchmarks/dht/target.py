"""Targets for this library, as absolute figures or relative to other libraries in the same run.

For libraries that are never in the run (Entangled of 2011, libp2p), the figures of an earlier comparison are used. A
result ``None`` means that a required figure was not measured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from benchmarks.dht.library import OURS, OURS_IN_MEMORY
from benchmarks.dht.rows import FAILED_PARTS, LOSSES, Reader, Result, make_reader, read_join_ms, read_slowest_ms

ENTANGLED_JOIN_MS = 3.4
ENTANGLED_OUT_MS, ENTANGLED_OUT_DATAGRAMS = 190.0, 520.0
ENTANGLED_DURABLE_PUTS = 81.0
LIBP2P_LONG_MS = 92.0
SLOW_MS = 1000.0

TORRENT, OPENDHT = "libtorrent-free", "opendht-free"
OPERATIONS = ("put", "get", "gets", "puts")

Row = Mapping[str, Result]
"""The results of one network size, by library."""
RowReader = Callable[[Row], float | None]


class Limit(NamedTuple):
    """A figure that must be at most (``is_maximum``) or at least ``bound``."""

    what: str
    value: float | None
    bound: float | None
    is_maximum: bool = True

    @property
    def is_met(self) -> bool | None:
        """Return whether the figure meets the limit; None if the figure is unknown."""
        if self.value is None or self.bound is None:
            return None
        return self.value <= self.bound if self.is_maximum else self.value >= self.bound

    def __str__(self) -> str:
        value, bound = ("?" if v is None else f"{v:,.2f}" if v < 100 else f"{v:,.0f}" for v in (self.value, self.bound))
        return f"{self.what} {value} ({'at most' if self.is_maximum else 'at least'} {bound})"


class TargetResult(NamedTuple):
    """The result of one target."""

    number: int
    title: str
    limits: list[Limit]

    @property
    def is_met(self) -> bool | None:
        """False if any limit is missed, None if none is missed but some are unknown."""
        held = [limit.is_met for limit in self.limits]
        return False if False in held else None if None in held else True


class LimitDefinition(NamedTuple):
    """A figure of a row with its maximum (``is_maximum``) or minimum."""

    what: str
    reader: RowReader
    bound: RowReader | float
    is_maximum: bool = True

    def make_limit(self, row: Row) -> Limit:
        """Return the limit with the figures of ``row``."""
        bound = self.bound if isinstance(self.bound, float) else self.bound(row)
        return Limit(self.what, self.reader(row), bound, self.is_maximum)


class Target(NamedTuple):
    """A target: a title and all limits that must be met."""

    title: str
    limit_definitions: tuple[LimitDefinition, ...]


# -- sources of the figures ----------------------------------------------------------------------------------------


def get_own_result(row: Row) -> Result:
    """Return the results of this library in ``row``: with SQLite, otherwise in memory."""
    return row.get(OURS) or row.get(OURS_IN_MEMORY) or {}


def make_own_reader(read: Reader) -> RowReader:
    """Return a function that applies ``read`` to the results of this library."""
    return lambda row: read(get_own_result(row))


def make_peer_reader(read: Reader, *names: str, factor: float) -> RowReader:
    """Return ``factor`` times the least figure that ``read`` finds in the results of the libraries ``names``."""

    def least(row: Row) -> float | None:
        found = [value for name in names if (value := read(row.get(name, {}))) is not None]
        return factor * min(found) if found else None

    return least


def count_idle_phases(result: Result) -> float | None:
    """Return the number of phases without results: all operations failed, or a test of node failures ended early."""
    idle = [name for name in OPERATIONS if name in result and result[name]["tried"] == result[name]["failed"]]
    stuck = [loss for loss in LOSSES if "trouble" in result.get(loss, {})]
    return float(len(idle) + len(stuck)) if result else None


def count_failed(result: Result) -> float | None:
    """Return the number of failed operations while all nodes were healthy."""
    return float(sum(result[name]["failed"] for name in OPERATIONS if name in result)) if result else None


def find_least_found(result: Result) -> float | None:
    """Return the least share of keys found after any failure, in percent; None if not all were tested."""
    found = [make_reader(loss, part, "found_percent")(result) for loss in LOSSES for part in FAILED_PARTS]
    known = [value for value in found if value is not None]
    return min(known) if len(known) == len(found) else None


# -- the targets ----------------------------------------------------------------------------------------------------

_REMOTE, _PUT, _GETS, _PUTS = (
    make_reader("remote_get", "p50"),
    make_reader("put", "p50"),
    make_reader("gets", "per_s"),
    make_reader("puts", "per_s"),
)
_GET_CPU, _PUT_CPU, _WATCH = make_reader("gets", "cpu_ms"), make_reader("puts", "cpu_ms"), make_reader("watch", "p50")

TARGETS = (
    Target(
        "remote get",
        (LimitDefinition("p50 ms", make_own_reader(_REMOTE), make_peer_reader(_REMOTE, TORRENT, factor=0.9)),),
    ),
    Target(
        "put, a majority acked",
        (LimitDefinition("p50 ms", make_own_reader(_PUT), make_peer_reader(_PUT, TORRENT, OPENDHT, factor=0.9)),),
    ),
    Target(
        "gets/s",
        (
            LimitDefinition(
                "gets/s", make_own_reader(_GETS), make_peer_reader(_GETS, TORRENT, factor=1.2), is_maximum=False
            ),
        ),
    ),
    Target(
        "puts/s",
        (
            LimitDefinition(
                "puts/s", make_own_reader(_PUTS), make_peer_reader(_PUTS, OPENDHT, factor=1.4), is_maximum=False
            ),
        ),
    ),
    Target(
        "datagrams",
        (
            LimitDefinition("a remote get", make_own_reader(make_reader("remote_get", "datagrams")), 3.0),
            LimitDefinition("a put", make_own_reader(make_reader("put", "datagrams")), 18.0),
        ),
    ),
    Target(
        "CPU of all nodes",
        (
            LimitDefinition("ms a get", make_own_reader(_GET_CPU), make_peer_reader(_GET_CPU, TORRENT, factor=0.8)),
            LimitDefinition("ms a put", make_own_reader(_PUT_CPU), make_peer_reader(_PUT_CPU, OPENDHT, factor=0.8)),
        ),
    ),
    Target("join (Entangled 2011)", (LimitDefinition("ms", make_own_reader(read_join_ms), ENTANGLED_JOIN_MS),)),
    Target(
        "a half silent",
        (
            LimitDefinition(
                "found %", make_own_reader(make_reader("silent", "a half", "found_percent")), 100.0, is_maximum=False
            ),
            LimitDefinition("p95 ms", make_own_reader(make_reader("silent", "a half", "p95")), 20.0),
            LimitDefinition("max ms", make_own_reader(make_reader("silent", "a half", "max")), 60.0),
        ),
    ),
    Target(
        "always done, within 1 s",
        (
            LimitDefinition("phases with nothing done", make_own_reader(count_idle_phases), 0.0),
            LimitDefinition("operations failed", make_own_reader(count_failed), 0.0),
            LimitDefinition("found % after losses", make_own_reader(find_least_found), 100.0, is_maximum=False),
            LimitDefinition("slowest ms", make_own_reader(read_slowest_ms), SLOW_MS),
        ),
    ),
    Target(
        "watch",
        (
            LimitDefinition("p50 ms", make_own_reader(_WATCH), make_peer_reader(_WATCH, OPENDHT, factor=0.8)),
            LimitDefinition("lost", make_own_reader(make_reader("watch", "lost")), 0.0),
        ),
    ),
    Target(
        "tuple put (Entangled 2011)",
        (
            LimitDefinition("p50 ms", make_own_reader(make_reader("space", "put", "p50")), ENTANGLED_OUT_MS / 35),
            LimitDefinition(
                "datagrams", make_own_reader(make_reader("space", "put", "datagrams")), ENTANGLED_OUT_DATAGRAMS / 10
            ),
        ),
    ),
    Target(
        "tuples are there, taken once",
        (
            LimitDefinition(
                "found %", make_own_reader(make_reader("space", "crowd", "found_percent")), 100.0, is_maximum=False
            ),
            LimitDefinition(
                "races with one winner",
                make_own_reader(make_reader("space", "race", "single_winner")),
                make_own_reader(make_reader("space", "race", "of")),
                is_maximum=False,
            ),
            LimitDefinition("wake-ups lost", make_own_reader(make_reader("space", "wake", "lost")), 0.0),
        ),
    ),
    Target(
        "1 MiB (libp2p)",
        (
            LimitDefinition("put p50 ms", make_own_reader(make_reader("long", "put", "p50")), LIBP2P_LONG_MS),
            LimitDefinition("failed at 5 % loss", make_own_reader(make_reader("long_lossy", "failed")), 0.0),
        ),
    ),
    Target(
        "durable put",
        (
            LimitDefinition("p50 ms", make_own_reader(_PUT), make_peer_reader(_PUT, OURS_IN_MEMORY, factor=1.2)),
            LimitDefinition(
                "puts/s", make_peer_reader(_PUTS, OURS, factor=1.0), 20 * ENTANGLED_DURABLE_PUTS, is_maximum=False
            ),
        ),
    ),
)


def check_targets(row: Row) -> list[TargetResult]:
    """Return the results of all fourteen targets for one network size."""
    return [
        TargetResult(number, target.title, [wanted.make_limit(row) for wanted in target.limit_definitions])
        for number, target in enumerate(TARGETS, 1)
    ]
