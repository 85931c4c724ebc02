"""Scenario: what happens to a team, out of a TOML file that is checked before the first step.

Whatever is wrong is one ``BadSetting``: the file and line, the key, what is wrong, and what to write instead.
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

from formats.convert import LINE, Invalid, Unit, convert_field, convert_table, one_of, some_of
from middleware.errors import BadSetting
from sim.team.faults.settings import Fault, fault_problem
from sim.team.figure import Bound, bound_of
from sim.team.link import LinkSettings
from sim.team.session import KINDS, Session

FOLDER = Path(__file__).resolve().parent.parent / "scenarios"
NODE_KINDS = ("entangled", "swarm")
WAYS = ("one by one", "batches", "at once")
NAT_KINDS = ("full", "addr", "port", "leaky", "sym", "noudp")
MOST_NODES = 100_000
MOST_FAULTS = 1000
T = TypeVar("T")
Settings = Mapping[str, type[Any]]
"""By the name of a sort of workload, the frozen dataclass of its settings."""


@dataclass(frozen=True)
class Join:
    """``[join]``: how the team comes together."""

    how: Annotated[str, one_of(WAYS)] = "one by one"
    """``one by one``, ``pause`` seconds apart; in ``batches`` of ``size``; all ``at once`` when the first is there."""

    pause: Annotated[float, Meta(ge=0.0, le=3600.0), Unit("seconds")] = 0.05
    """Seconds between two nodes, or two batches."""

    size: Annotated[int, Meta(ge=1, le=MOST_NODES)] = 50
    """Nodes of one batch."""

    known: Annotated[int, Meta(ge=1, le=20)] = 2
    """How many nodes a newcomer knows, of those that are in; the first nodes know only the first one."""

    within: Annotated[float, Meta(ge=1.0, le=86_400.0), Unit("seconds")] = 120.0
    """Seconds after the last one came, in which all must be in; who is not is a violation."""

    settle: Annotated[float, Meta(ge=0.0, le=86_400.0), Unit("seconds")] = 10.0
    """Seconds of quiet, once all are in, before anything is measured."""


@dataclass(frozen=True)
class Sessions:
    """``[sessions]``: how long nodes stay.  Without a median nobody leaves."""

    kind: Annotated[str, one_of(KINDS)] = "exponential"
    """How the durations are distributed."""

    median: Annotated[float, Meta(ge=0.0, le=1e7), Unit("seconds")] = 0.0
    """Seconds that half of the sessions outlast."""

    away: Annotated[float, Meta(ge=0.1, le=1e7), Unit("seconds")] = 10.0
    """Median seconds until the next session at that place, of the same distribution."""

    goodbye: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    """Share of the sessions that end with a word to the others; the rest ends as a loss of power does."""

    same: bool = True
    """Whether the same node comes back, from its disk; else a newcomer takes its place."""

    @property
    def stays(self) -> Session | None:
        """How long sessions are; None where they do not end."""
        return Session(self.kind, self.median) if self.median else None

    @property
    def breaks(self) -> Session:
        """How long nodes are away."""
        return Session(self.kind, self.away)


@dataclass(frozen=True)
class Clocks:
    """``[clocks]``: how wrong the nodes' clocks are."""

    drift: Annotated[float, Meta(ge=0.0, le=0.2)] = 0.0
    """Largest error of a rate: with 0.01 each clock runs between 0.99 and 1.01 times as fast as the world's."""

    wall: Annotated[float, Meta(ge=0.0, le=1e7), Unit("seconds")] = 0.0
    """Seconds by which wall clocks are wrong at most, when the team begins."""


@dataclass(frozen=True)
class Nats:
    """``[nat]``: who sits behind a router that translates addresses."""

    share: Annotated[float, Meta(ge=0.0, le=0.9)] = 0.0
    """Share of the nodes, each behind a router of its own; the first ones never are."""

    kinds: Annotated[tuple[str, ...], some_of(NAT_KINDS)] = ("port",)
    """The sorts of routers, in turn (``network.nat``)."""


@dataclass(frozen=True)
class Scenario:
    """What happens to a team."""

    about: Annotated[str, Meta(max_length=200), LINE] = ""
    """A line for people."""

    nodes: Annotated[int, Meta(ge=1, le=MOST_NODES)] = 10
    """Places in the team; ``--nodes`` takes its place."""

    kind: Annotated[str, one_of(NODE_KINDS)] = "entangled"
    """What nodes are: peers of the network alone (``entangled``), or the whole node of a device (``swarm``)."""

    seconds: Annotated[float, Meta(ge=0.0, le=1e7), Unit("seconds")] = 30.0
    """How long it lasts, from the moment when the team stands."""

    lead: Annotated[float, Meta(ge=0.0, le=1e7), Unit("seconds")] = 0.0
    """Seconds of it that pass before the workloads begin to act."""

    repair: Annotated[float, Meta(ge=0.0, le=1e6), Unit("seconds")] = 0.0
    """Seconds that the team is given after that, with all faults taken back, before it is asked what it knows."""

    step: Annotated[float, Meta(ge=0.01, le=60.0), Unit("seconds")] = 0.5
    """Seconds between two steps of the workloads."""

    lease: Annotated[float, Meta(ge=0.1, le=60.0), Unit("seconds")] = 1.0
    """Seconds for which what a node owns on lease outlives its last sign of life."""

    disks: bool = False
    """Whether nodes keep what they hold on disks that take a moment, can be full, and lose the last moment with the
    power; without, what a node held is all there in its next life."""

    join: Join = Join()
    link: LinkSettings = LinkSettings()
    sessions: Sessions = Sessions()
    clocks: Clocks = Clocks()
    nat: Nats = Nats()
    faults: tuple[Fault, ...] = ()
    loads: tuple[tuple[str, Any], ...] = ()
    """The workloads: the name of the sort, and its settings."""
    targets: tuple[tuple[str, Bound], ...] = ()
    """What figures are held to, beside what their workloads hold them to."""
    name: str = ""

    @property
    def has_machines(self) -> bool:
        """Whether nodes have clocks of their own, that can be wrong and stand still."""
        return bool(self.clocks.drift) or any(fault.kind in ("freeze", "rate") for fault in self.faults)

    @property
    def has_disks(self) -> bool:
        """Whether nodes have disks."""
        return self.disks or any(fault.kind == "full" for fault in self.faults)


TABLES: dict[str, type[Any]] = {
    "join": Join,
    "link": LinkSettings,
    "sessions": Sessions,
    "clocks": Clocks,
    "nat": Nats,
}


def names() -> list[str]:
    """The scenarios that ship."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def loaded(name: str, settings: Settings, changes: Mapping[str, object] = {}) -> Scenario:  # noqa: B006  (never changed)
    """The scenario of that name, or in that file; ``changes`` are keys of the command line that take the file's place.

    ``settings`` has the sorts of workloads.  Raises ``BadSetting``.
    """
    path = _path(name)
    if not name.endswith(".toml") and not path.exists():
        near = get_close_matches(name, names(), n=1)
        remedy = f"there are {', '.join(names())}{f'; the nearest is {near[0]}' if near else ''}"
        raise BadSetting("command line", "--scenario", f"there is no {name!r}", remedy)
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
        raise BadSetting(str(path), "", problem, "name a scenario, such as steady, or a file") from error
    except UnicodeDecodeError as error:
        raise BadSetting(str(path), "", "is no text in UTF-8", "write it anew") from error
    return scenario_of(text, str(path), path.stem, settings, changes)


def place_of(name: str, where: str, key: str) -> str:
    """The file and line of a key of the table ``where`` in a scenario that was ``loaded`` by that name."""
    path = _path(name)
    line = dict(_places(path.read_text(encoding="utf-8"))).get((where, key))
    return f"{path}:{line}" if line else str(path)


def remedy_of(word: str, known: Sequence[str]) -> str:
    """What to write instead of a word that is none of those that are ``known``."""
    near = get_close_matches(word, known, n=1)
    return f"the nearest is {near[0]}" if near else f"there are {', '.join(known)}"


def scenario_of(
    text: str,
    origin: str,
    name: str,
    settings: Settings,
    changes: Mapping[str, object] = {},  # noqa: B006
) -> Scenario:
    """The scenario that a file's text means; raises ``BadSetting``."""
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BadSetting(origin, "", f"is not TOML: {error}", "mend that line") from error
    reader = _Reader(origin, text)
    scenario = reader.scenario(content, name, settings, changes)
    reader.check(scenario)
    return scenario


def _path(name: str) -> Path:
    return Path(name) if name.endswith(".toml") else FOLDER / f"{name}.toml"


class _Reader:
    """Reads the tables of one file, and knows in which line each key stands."""

    def __init__(self, origin: str, text: str) -> None:
        self._origin = origin
        self._lines = dict(_places(text))

    def scenario(
        self, content: dict[str, Any], name: str, settings: Settings, changes: Mapping[str, object]
    ) -> Scenario:
        """The scenario, each value by itself as it should be."""
        own = [f.name for f in fields(Scenario) if f.name not in (*TABLES, "faults", "loads", "targets", "name")]
        known = [*own, *TABLES, "fault", "load", "targets"]
        self._known(content, "", known)
        parts: dict[str, Any] = {key: self._value(key, content[key]) for key in own if key in content}
        for key, value in changes.items():
            parts[key] = self._value(key, value, f"--{key}")
        for key, sort in TABLES.items():
            parts[key] = self._table(sort, content.get(key, {}), key)
        faults = content.get("fault", [])
        if not isinstance(faults, list) or len(faults) > MOST_FAULTS:
            raise self.bad("", "fault", f"must be tables, {MOST_FAULTS} at most", "write [[fault]] for each")
        parts["faults"] = tuple(self._table(Fault, fault, f"fault {n}") for n, fault in enumerate(faults, 1))
        parts["loads"] = tuple(self._loads(content.get("load", {}), settings))
        parts["targets"] = tuple(self._targets(content.get("targets", {})))
        return Scenario(**parts, name=name)

    def check(self, scenario: Scenario) -> None:
        """Raise ``BadSetting`` for what is impossible together."""
        link, nat, join = scenario.link, scenario.nat, scenario.join
        if scenario.lead and scenario.lead >= scenario.seconds:
            raise self.bad("", "lead", f"leaves nothing of {scenario.seconds:g} s", "let the scenario last longer")
        if link.burst and not link.loss:
            raise self.bad("link", "burst", "means nothing without loss", "write loss = 0.05, or leave burst out")
        if link.burst and link.asymmetry:
            raise self.bad("link", "asymmetry", "cannot go with bursts, which are a sender's", "leave one of them out")
        if link.asymmetry and not link.loss:
            raise self.bad("link", "asymmetry", "means nothing without loss", "write loss = 0.05, or leave it out")
        if nat.share and scenario.nodes <= join.known:
            raise self.bad("nat", "share", f"leaves nobody outside in a team of {scenario.nodes}", "take more nodes")
        if join.how == "batches" and join.size > scenario.nodes:
            raise self.bad("join", "size", f"is more than the {scenario.nodes} nodes", 'write how = "at once"')
        if scenario.sessions.median and scenario.nodes < 3:
            raise self.bad("sessions", "median", "would leave nobody to come back to", "take at least 3 nodes")
        for number, fault in enumerate(scenario.faults, 1):
            problem = fault_problem(fault, scenario.nodes, scenario.seconds)
            if problem is None and fault.kind == "rebind" and not nat.share:
                problem = "kind", "needs routers to restart", "write [nat] share = 0.3"
            if problem is not None:
                raise self.bad(f"fault {number}", *problem)

    def bad(self, where: str, key: str, problem: str, remedy: str, shown: str = "") -> BadSetting:
        """The error, with the line."""
        whole = f"{where}.{key}".strip(".")
        above, _, last = whole.rpartition(".")
        # A table is a header, or a key of the table above it; an inline one stands in the line of its key.
        places = (where, key), (whole, ""), (above, last), (where, ""), ("", where.partition(".")[0])
        line = next((self._lines[place] for place in places if place in self._lines), 0)
        table = f"[[fault]] {where.split()[1]} " if where.startswith("fault ") else f"[{where}] " if where else ""
        if shown:
            return BadSetting("command line", shown, problem, remedy)
        return BadSetting(f"{self._origin}:{line}" if line else self._origin, f"{table}{key}".strip(), problem, remedy)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _table(self, sort: type[T], content: object, where: str) -> T:
        try:
            return convert_table(content, sort)
        except Invalid as error:
            raise self.bad(*((where, error.key) if error.key else ("", where)), error.problem, error.remedy) from error

    def _value(self, key: str, value: object, shown: str = "") -> object:
        try:
            return convert_field(value, Scenario, key)
        except Invalid as error:
            raise self.bad("", key, error.problem, error.remedy, shown) from error

    def _known(self, content: Mapping[str, object], where: str, known: list[str]) -> None:
        for key in content:
            if key not in known:
                raise self.bad(where, key, "is no such key", remedy_of(key, known))

    def _loads(self, content: object, settings: Settings) -> Iterator[tuple[str, Any]]:
        if not isinstance(content, dict):
            raise self.bad("", "load", "must be tables", "write [load.NAME] for each")
        for name, table in content.items():
            sort = settings.get(name)
            if sort is None:
                known = ", ".join(sorted(settings)) or "none"
                raise self.bad(f"load.{name}", "", "is no sort of workload", f"there are {known}")
            yield name, self._table(sort, table, f"load.{name}")

    def _targets(self, content: object) -> Iterator[tuple[str, Bound]]:
        if not isinstance(content, dict):
            raise self.bad("", "targets", "must be a table", 'write [targets], and lines such as "hops" = "<= 5"')
        for name, text in content.items():
            try:
                yield name, bound_of(text if isinstance(text, str) else "")
            except ValueError:
                raise self.bad("targets", name, "is no bound", 'write "<= 450" or ">= 0.999", in quotes') from None


def _places(text: str) -> Iterator[tuple[tuple[str, str], int]]:
    """The line of each (table, key), and of each table with an empty key; a [[fault]] is "fault" and its number."""
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
