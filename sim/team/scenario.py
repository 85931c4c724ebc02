"""Load scenarios from TOML files, and validate them before the run.

Every error is a ``BadSetting`` with the file, the line, the key, the problem and the remedy.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, TypeVar

from msgspec import Meta

from formats.convert import PRINTABLE, InvalidValue, Unit, convert_field, convert_table, one_of, some_of
from middleware.errors import BadSetting
from sim.team.durations import KINDS, DurationDistribution
from sim.team.faults.settings import Fault, find_problem
from sim.team.link import LinkSettings
from sim.team.metric import Bound, parse_bound

FOLDER = Path(__file__).resolve().parent.parent / "scenarios"
NODE_KINDS = ("entangled", "swarm")
JOIN_ORDERS = ("one by one", "batches", "at once")
NAT_KINDS = ("full", "addr", "port", "leaky", "sym", "noudp")
MAX_NODES = 100_000
MAX_FAULTS = 1000
T = TypeVar("T")
Settings = Mapping[str, type[Any]]
"""The settings dataclass (frozen) of each kind of workload, by name."""


@dataclass(frozen=True)
class Join:
    """``[join]``: the order and pace of joining."""

    how: Annotated[str, one_of(JOIN_ORDERS)] = "one by one"
    """``one by one``, ``pause`` seconds apart; in ``batches`` of ``size``; or all ``at once`` after the first node."""

    pause: Annotated[float, Meta(ge=0.0, le=3600.0), Unit("seconds")] = 0.05
    """Seconds between two nodes or two batches."""

    size: Annotated[int, Meta(ge=1, le=MAX_NODES)] = 50
    """Number of nodes in a batch."""

    known: Annotated[int, Meta(ge=1, le=20)] = 2
    """Number of joined nodes that a joining node knows; the earliest nodes know only the first node."""

    within: Annotated[float, Meta(ge=1.0, le=86_400.0), Unit("seconds")] = 120.0
    """Seconds after the start of the last node within which all nodes must have joined; otherwise it is a violation."""

    settle: Annotated[float, Meta(ge=0.0, le=86_400.0), Unit("seconds")] = 10.0
    """Seconds after all have joined before anything is measured."""


@dataclass(frozen=True)
class Sessions:
    """``[sessions]``: the durations of nodes' sessions.  Without a median no node leaves."""

    kind: Annotated[str, one_of(KINDS)] = "exponential"
    """The distribution of durations."""

    median: Annotated[float, Meta(ge=0.0, le=1e7), Unit("seconds")] = 0.0
    """Median duration of a session in seconds."""

    away: Annotated[float, Meta(ge=0.1, le=1e7), Unit("seconds")] = 10.0
    """Median time in seconds until the next session at the same place, with the same distribution."""

    goodbye: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    """Share of sessions that end with a graceful leave; the others end like a loss of power."""

    same: bool = True
    """Whether the same node returns with its disk; otherwise a new node takes its place."""

    @property
    def session_durations(self) -> DurationDistribution | None:
        """The durations of sessions; None if they do not end."""
        return DurationDistribution(self.kind, self.median) if self.median else None

    @property
    def absence_durations(self) -> DurationDistribution:
        """The durations of absences."""
        return DurationDistribution(self.kind, self.away)


@dataclass(frozen=True)
class Clocks:
    """``[clocks]``: errors of the nodes' clocks."""

    drift: Annotated[float, Meta(ge=0.0, le=0.2)] = 0.0
    """Maximum error of a clock's rate: with 0.01 clocks run 0.99 to 1.01 times as fast as the simulator's clock."""

    wall: Annotated[float, Meta(ge=0.0, le=1e7), Unit("seconds")] = 0.0
    """Maximum initial error of wall clocks in seconds."""


@dataclass(frozen=True)
class Nats:
    """``[nat]``: nodes behind NAT routers."""

    share: Annotated[float, Meta(ge=0.0, le=0.9)] = 0.0
    """Share of nodes that are each behind their own router; the first nodes never are."""

    kinds: Annotated[tuple[str, ...], some_of(NAT_KINDS)] = ("port",)
    """The kinds of routers, assigned in turn (``network.nat_router``)."""


@dataclass(frozen=True)
class Scenario:
    """A scenario."""

    about: Annotated[str, Meta(max_length=200), PRINTABLE] = ""
    """A description in one line."""

    nodes: Annotated[int, Meta(ge=1, le=MAX_NODES)] = 10
    """Number of places in the team; ``--nodes`` replaces it."""

    kind: Annotated[str, one_of(NODE_KINDS)] = "entangled"
    """Kind of nodes: peers of the library (``entangled``), or whole device nodes (``swarm``)."""

    seconds: Annotated[float, Meta(ge=0.0, le=1e7), Unit("seconds")] = 30.0
    """Duration after the team has settled."""

    lead: Annotated[float, Meta(ge=0.0, le=1e7), Unit("seconds")] = 0.0
    """Seconds at the start of this duration before the workloads start."""

    repair: Annotated[float, Meta(ge=0.0, le=1e6), Unit("seconds")] = 0.0
    """Seconds from the end of all faults until the final requests."""

    step: Annotated[float, Meta(ge=0.01, le=60.0), Unit("seconds")] = 0.5
    """Seconds between two steps of the workloads."""

    lease: Annotated[float, Meta(ge=0.1, le=60.0), Unit("seconds")] = 1.0
    """Seconds after the last renewal for which leased records of a node are valid."""

    disks: bool = False
    """Whether nodes have simulated disks, which commit with a delay, can be full, and lose pending writes when the
    power fails. Otherwise all data of a node survives a restart."""

    join: Join = Join()
    link: LinkSettings = LinkSettings()
    sessions: Sessions = Sessions()
    clocks: Clocks = Clocks()
    nat: Nats = Nats()
    faults: tuple[Fault, ...] = ()
    loads: tuple[tuple[str, Any], ...] = ()
    """The workloads: kind and settings."""
    targets: tuple[tuple[str, Bound], ...] = ()
    """Targets of figures, in addition to those of the workloads."""
    name: str = ""

    @property
    def has_machines(self) -> bool:
        """Whether nodes have their own clocks, which can drift and stop."""
        return bool(self.clocks.drift) or any(fault.kind in ("freeze", "rate") for fault in self.faults)

    @property
    def has_disks(self) -> bool:
        """Whether nodes have simulated disks."""
        return self.disks or any(fault.kind == "full" for fault in self.faults)


TABLES: dict[str, type[Any]] = {
    "join": Join,
    "link": LinkSettings,
    "sessions": Sessions,
    "clocks": Clocks,
    "nat": Nats,
}


def list_names() -> list[str]:
    """Return the names of the built-in scenarios."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def load_scenario(name: str, settings: Settings, changes: Mapping[str, object] = {}) -> Scenario:  # noqa: B006  (never changed)
    """Load a scenario by name or file; ``changes`` are values of the command line that override the file.

    ``settings`` contains the kinds of workloads. Raises ``BadSetting``.
    """
    path = _find_path(name)
    if not name.endswith(".toml") and not path.exists():
        near = get_close_matches(name, list_names(), n=1)
        remedy = f"there are {', '.join(list_names())}{f'; the nearest is {near[0]}' if near else ''}"
        raise BadSetting("command line", "--scenario", f"unknown scenario {name!r}", remedy)
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
        raise BadSetting(str(path), "", problem, "choose the name of a scenario, such as steady, or a file") from error
    except UnicodeDecodeError as error:
        raise BadSetting(str(path), "", "is not UTF-8 text", "save it in UTF-8") from error
    return parse_scenario(text, str(path), path.stem, settings, changes)


def find_position(name: str, where: str, key: str) -> str:
    """Return the file and line of a key of the table ``where`` in a scenario that was loaded by ``name``."""
    path = _find_path(name)
    line = dict(_find_lines(path.read_text(encoding="utf-8"))).get((where, key))
    return f"{path}:{line}" if line else str(path)


def make_remedy(word: str, known: Sequence[str]) -> str:
    """Return a remedy for an unknown word: the nearest word in ``known``, or all words in it."""
    near = get_close_matches(word, known, n=1)
    return f"the nearest is {near[0]}" if near else f"there are {', '.join(known)}"


def parse_scenario(
    text: str,
    origin: str,
    name: str,
    settings: Settings,
    changes: Mapping[str, object] = {},  # noqa: B006
) -> Scenario:
    """Parse a scenario; raises ``BadSetting``."""
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BadSetting(origin, "", f"is not TOML: {error}", "fix that line") from error
    reader = _Reader(origin, text)
    scenario = reader.read_scenario(content, name, settings, changes)
    reader.check(scenario)
    return scenario


def _find_path(name: str) -> Path:
    return Path(name) if name.endswith(".toml") else FOLDER / f"{name}.toml"


class _Reader:
    """A reader of one file's tables, with the line of each key."""

    def __init__(self, origin: str, text: str) -> None:
        self._origin = origin
        self._lines = dict(_find_lines(text))

    def read_scenario(
        self, content: dict[str, Any], name: str, settings: Settings, changes: Mapping[str, object]
    ) -> Scenario:
        """Return the scenario, with each value validated on its own."""
        own = [f.name for f in fields(Scenario) if f.name not in (*TABLES, "faults", "loads", "targets", "name")]
        known = [*own, *TABLES, "fault", "load", "targets"]
        self._require_known(content, "", known)
        parts: dict[str, Any] = {key: self._read_value(key, content[key]) for key in own if key in content}
        for key, value in changes.items():
            parts[key] = self._read_value(key, value, f"--{key}")
        for key, table_type in TABLES.items():
            parts[key] = self._read_table(table_type, content.get(key, {}), key)
        faults = content.get("fault", [])
        if not isinstance(faults, list) or len(faults) > MAX_FAULTS:
            raise self.make_error("", "fault", f"must be tables, {MAX_FAULTS} at most", "write [[fault]] for each")
        parts["faults"] = tuple(self._read_table(Fault, fault, f"fault {n}") for n, fault in enumerate(faults, 1))
        parts["loads"] = tuple(self._read_loads(content.get("load", {}), settings))
        parts["targets"] = tuple(self._read_targets(content.get("targets", {})))
        return Scenario(**parts, name=name)

    def check(self, scenario: Scenario) -> None:
        """Raise ``BadSetting`` for values that are valid on their own, but not together."""
        link, nat, join = scenario.link, scenario.nat, scenario.join
        if scenario.lead and scenario.lead >= scenario.seconds:
            raise self.make_error(
                "", "lead", f"must be less than seconds, which is {scenario.seconds:g}", "increase seconds"
            )
        if link.burst and not link.loss:
            raise self.make_error(
                "link", "burst", "has no effect without loss", "write loss = 0.05, or leave burst out"
            )
        if link.burst and link.asymmetry:
            raise self.make_error("link", "asymmetry", "cannot be combined with burst", "leave one of them out")
        if link.asymmetry and not link.loss:
            raise self.make_error(
                "link", "asymmetry", "has no effect without loss", "write loss = 0.05, or leave it out"
            )
        if nat.share and scenario.nodes <= join.known:
            raise self.make_error("nat", "share", f"has no effect in a team of {scenario.nodes}", "use more nodes")
        if join.how == "batches" and join.size > scenario.nodes:
            raise self.make_error("join", "size", f"is more than the {scenario.nodes} nodes", 'write how = "at once"')
        if scenario.sessions.median and scenario.nodes < 3:
            raise self.make_error("sessions", "median", "needs nodes that stay", "use at least 3 nodes")
        for number, fault in enumerate(scenario.faults, 1):
            problem = find_problem(fault, scenario.nodes, scenario.seconds)
            if problem is None and fault.kind == "rebind" and not nat.share:
                problem = "kind", "needs routers to restart", "write [nat] share = 0.3"
            if problem is not None:
                raise self.make_error(f"fault {number}", *problem)

    def make_error(self, where: str, key: str, problem: str, remedy: str, shown: str = "") -> BadSetting:
        """Return the error with its line."""
        whole = f"{where}.{key}".strip(".")
        above, _, last = whole.rpartition(".")
        # A table has a header or is a key of its parent table; an inline table is on the line of its key.
        places = (where, key), (whole, ""), (above, last), (where, ""), ("", where.partition(".")[0])
        line = next((self._lines[place] for place in places if place in self._lines), 0)
        table = f"[[fault]] {where.split()[1]} " if where.startswith("fault ") else f"[{where}] " if where else ""
        if shown:
            return BadSetting("command line", shown, problem, remedy)
        return BadSetting(f"{self._origin}:{line}" if line else self._origin, f"{table}{key}".strip(), problem, remedy)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _read_table(self, table_type: type[T], content: object, where: str) -> T:
        try:
            return convert_table(content, table_type)
        except InvalidValue as error:
            raise self.make_error(
                *((where, error.key) if error.key else ("", where)), error.problem, error.remedy
            ) from error

    def _read_value(self, key: str, value: object, shown: str = "") -> object:
        try:
            return convert_field(value, Scenario, key)
        except InvalidValue as error:
            raise self.make_error("", key, error.problem, error.remedy, shown) from error

    def _require_known(self, content: Mapping[str, object], where: str, known: list[str]) -> None:
        for key in content:
            if key not in known:
                raise self.make_error(where, key, "is an unknown key", make_remedy(key, known))

    def _read_loads(self, content: object, settings: Settings) -> Iterator[tuple[str, Any]]:
        if not isinstance(content, dict):
            raise self.make_error("", "load", "must be tables", "write [load.NAME] for each")
        for name, table in content.items():
            table_type = settings.get(name)
            if table_type is None:
                known = ", ".join(sorted(settings)) or "none"
                raise self.make_error(f"load.{name}", "", "is an unknown workload", f"there are {known}")
            yield name, self._read_table(table_type, table, f"load.{name}")

    def _read_targets(self, content: object) -> Iterator[tuple[str, Bound]]:
        if not isinstance(content, dict):
            raise self.make_error(
                "", "targets", "must be a table", 'write [targets], and lines such as "hops" = "<= 5"'
            )
        for name, text in content.items():
            try:
                yield name, parse_bound(text if isinstance(text, str) else "")
            except ValueError:
                raise self.make_error(
                    "targets", name, "is not a bound", 'write "<= 450" or ">= 0.999", in quotes'
                ) from None


def _find_lines(text: str) -> Iterator[tuple[tuple[str, str], int]]:
    """Yield the line of each (table, key), and of each table as (table, ""); the table of a [[fault]] is "fault N"."""
    where, faults = "", 0
    for number, line in enumerate(text.splitlines(), 1):
        if header := re.match(r"\s*\[\[?\s*([\w.\" -]+?)\s*\]\]?\s*(#.*)?$", line):
            where = header[1].replace('"', "")
            if where == "fault" and line.lstrip().startswith("[["):
                faults += 1
                where = f"{where} {faults}"
            yield (where, ""), number
        elif key := re.match(r"\s*(?:\"([^\"]+)\"|([\w.-]+))\s*=", line):
            table, _, name = (key[2] or "").rpartition(".")
            yield (".".join(filter(None, (where, table))), key[1] or name), number
