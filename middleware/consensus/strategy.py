"""The interface of strategies: pure functions from reports to the agent that should act, loaded by name.

A strategy sees the reports of the agents that take part in a task and selects the agent that should act (thesis,
section 4.2.5 and Algorithm 4.5: ``consensus.find(contacts)``, ``consensus.assigned_agent``). A wrong strategy makes a
bad choice, never an unsafe one: only the lease (``middleware.consensus.lease``) gives an agent the right to act.
"""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from middleware.consensus.deployed_modules import STRATEGY, DeployedModules, find_factory, is_deployed
from middleware.errors import UnknownStrategy

BUILT_IN = {
    "average": "middleware.consensus.strategies.average:Average",
    "capability_cost": "middleware.consensus.strategies.capability_cost:CapabilityCost",
    "cbba": "middleware.consensus.strategies.cbba:Cbba",
    "group_optimal": "middleware.consensus.strategies.group_optimal:GroupOptimal",
    "nearest": "middleware.consensus.strategies.nearest:Nearest",
    "rendezvous": "middleware.consensus.strategies.rendezvous:Rendezvous",
    "rendezvous_centre": "middleware.consensus.strategies.rendezvous:Centre",
    "rendezvous_median": "middleware.consensus.strategies.rendezvous:Median",
    "sequential": "middleware.consensus.strategies.sequential:Sequential",
    "weighted_vote": "middleware.consensus.strategies.weighted_vote:WeightedVote",
}
ENTRY_POINT_GROUP = "swarm_node.strategies"
MAX_NUMBER = 1e9
"""Upper bound of costs, weights and coordinates; sums of numbers below this bound do not lose precision."""
MAX_WHOLE = 2**53
MAX_NAME = 200
READABLE = ("battery", "load", "value", "choice", "weight", "electorate")
"""The fields of ``Report`` that a strategy may read besides the cost.  A strategy without ``reads`` gets all of them.
"""
MAX_SHOWN_CHARACTERS = 40
LABELS = ("cost", "weight", "electorate", "load", "age", "valid_for")


@dataclass(frozen=True, slots=True)
class Report:
    """One agent's report about one task.

    - ``agent``: the agent's uuid
    - ``cost``: the cost of acting, at least 0, in the strategy's unit (``nearest``: metres; ``capability_cost``:
      seconds)
    - ``task``: the task's id
    - ``epoch``: the round of the decision; only reports of the newest epoch are used
    - ``sequence``: the number of this report or vote; a higher one replaces a lower one of the same agent
    - ``value``: a number or a position in metres (``average``, ``rendezvous``), or the agent's position
      (``sequential``)
    - ``choice``: the option that the agent votes for; "" if it has not voted
    - ``weight``: the weight of ``value`` and ``choice``
    - ``electorate``: the total weight of all agents that may vote
    - ``capacity``: the number of tasks that the agent accepts
    - ``battery``: the remaining charge, 0 to 1
    - ``load``: the number of tasks that the agent already has
    - ``unmet``: the requirements of the task that the device does not meet
    - ``age``: seconds since the measurement.  Ages are durations because the clocks of two nodes differ.
    - ``valid_for``: seconds for which the report is valid; 0: as long as the agent is present
    """

    agent: str
    cost: float
    task: str = ""
    epoch: int = 0
    sequence: int = 0
    value: tuple[float, ...] = ()
    choice: str = ""
    weight: float = 1.0
    electorate: float = 0.0
    capacity: int = 1
    battery: float = 1.0
    load: float = 0.0
    unmet: tuple[str, ...] = ()
    age: float = 0.0
    valid_for: float = 0.0


@dataclass(frozen=True)
class Consensus:
    """The decision of a strategy (the thesis' consensus point).

    - ``assigned_agent``: the uuid of the agent that should act, or None
    - ``standby``: the uuids of the standbys, the best first
    - ``digest``: the digest of the reports that were used (``digest_of``)
    - ``task``, ``epoch``: the task and the round that were decided
    - ``assigned``: all agents that act, if the task has several slots
    - ``value``: the agreed number or position; ``choice``: the option that won the vote
    - ``strategy``, ``reason``: texts for display, which are ignored in comparisons
    """

    assigned_agent: str | None
    standby: tuple[str, ...] = ()
    digest: str = ""
    task: str = ""
    epoch: int = 0
    assigned: tuple[str, ...] = ()
    value: tuple[float, ...] = ()
    choice: str = ""
    strategy: str = field(default="", compare=False)
    reason: str = field(default="", compare=False)


class ConsensusAlgorithm(Protocol):
    """The interface of a strategy.  Each method is a pure function: equal reports in any order give an equal result.

    Invalid reports (``refusal``) must not affect any result; ``standing`` removes them.  Every node must break ties in
    the same way, for example by uuid.  ``middleware.consensus.conformance`` tests an implementation against all rules.

    A strategy may also have an attribute ``reads``: the fields that it uses besides the cost, which must be in
    ``READABLE``.  It may also have a method ``find_group``, which assigns several tasks jointly
    (``middleware.consensus.assignment``).
    """

    name: str
    version: str

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """Return the decision for the reports of all agents, including the caller.

        If there is no report, no agent is assigned.
        """

    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        """Return whether ``offer`` is better than ``current`` by more than ``hysteresis``.

        ``hysteresis`` is a share of the cost (0.1: 10 %).
        ``current`` is the report of the agent that acts now.  If the result is True, the task is reassigned to the
        agent of ``offer``.  An equal or invalid offer is never better.
        """

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """Return a summary of both sets of reports, for which ``find`` makes the same decision as for all reports.

        The operation is a join: commutative, associative and idempotent.
        """


def refusal(report: Report) -> str:
    """Return the reason why a report is invalid and therefore ignored, or "" if it is valid."""
    if not isinstance(report.agent, str) or not 0 < len(report.agent) <= MAX_NAME:
        return f"agent must be a string of 1 to {MAX_NAME} characters"
    numbers = (report.cost, report.weight, report.electorate, report.load, report.age, report.valid_for)
    if not all((type(n) is float or type(n) is int) and 0.0 <= n <= MAX_NUMBER for n in numbers):
        for label, number in zip(LABELS, numbers, strict=True):
            if why := _range_error(number):
                return f"{label} {why}"
    if not isinstance(report.value, tuple) or len(report.value) > 8:
        return "value must be a tuple of at most 8 numbers"
    for number in report.value:
        if why := _range_error(number, lowest=-MAX_NUMBER):
            return f"value {why}"
    if type(report.battery) not in (float, int) or not 0.0 <= report.battery <= 1.0:
        return f"battery {_format_number(report.battery)} is not between 0 and 1"
    for whole in (report.epoch, report.sequence, report.capacity):
        if type(whole) is not int or not 0 <= whole < MAX_WHOLE:
            return f"epoch, sequence or capacity {_format_number(whole)} is not a whole number from 0 to 2^53 - 1"
    for text in (report.task, report.choice):
        if not isinstance(text, str) or len(text) > MAX_NAME:
            return f"task and choice must be strings of at most {MAX_NAME} characters"
    if report.unmet:
        return "requirements not met: " + ", ".join(map(str, report.unmet))[:MAX_NAME]
    if 0.0 < report.valid_for < report.age:
        return f"stale: {report.age:g} s old, valid for {report.valid_for:g} s"
    return ""


def get_cost(report: Report) -> float:
    """Return the report's cost: the default rank."""
    return report.cost


def standing(contacts: Iterable[Report], rank: Callable[[Report], float] = get_cost) -> tuple[Report, ...]:
    """Return the valid reports of the newest epoch, one per task and agent, sorted by task and agent.

    If an agent has several reports for a task, the report with the lowest ``rank`` is used. The operation is a join:
    order, grouping and repetition of the reports make no difference.
    """
    valid = [r for r in contacts if not refusal(r)]
    epoch = max((r.epoch for r in valid), default=0)
    best: dict[tuple[str, str], Report] = {}
    for report in valid:
        if report.epoch == epoch:
            known = best.setdefault((report.task, report.agent), report)
            if known is not report and _sort_key(report, rank) < _sort_key(known, rank):
                best[report.task, report.agent] = report
    return tuple(best[key] for key in sorted(best))


def build_consensus(
    name: str,
    order: Sequence[Report],
    counted: Sequence[Report],
    reason: str,
    value: tuple[float, ...] = (),
    choice: str = "",
) -> Consensus:
    """Build the decision of the strategy ``name``: the first agent of ``order`` acts, the others are standbys.

    If ``order`` is empty, no agent is assigned.  ``counted`` are the reports that were used: at least one, all with the
    same task and epoch.
    """
    agents = tuple(r.agent for r in order)
    return Consensus(
        agents[0] if agents else None,
        agents[1:],
        digest_of(counted),
        counted[0].task,
        counted[0].epoch,
        agents[:1],
        value,
        choice,
        name,
        reason,
    )


def find_read_fields(strategy: object) -> tuple[str, ...]:
    """Return the fields that ``strategy`` reads besides the cost, in the order of ``READABLE``.

    A strategy without ``reads`` gets all fields.
    """
    try:
        declared = tuple(getattr(strategy, "reads", READABLE))
        return tuple(name for name in READABLE if name in declared)
    except Exception:  # third-party code may raise anything
        return READABLE


def format_agreement(value: tuple[float, ...], choice: str) -> str:
    """Format the agreed number, position or option for display; "" if nothing was agreed."""
    if choice:
        return choice[:MAX_SHOWN_CHARACTERS]
    if len(value) == 1:
        return f"{value[0]:.2f}"
    return f"({', '.join(f'{number:.2f}' for number in value)})" if value else ""


def digest_of(contacts: Iterable[Report]) -> str:
    """Return a digest of eight hexadecimal digits, which does not depend on the order of the reports."""
    texts = sorted(f"{r.agent}={r.cost + 0.0:.6f};{_optional_fields(r)}" for r in contacts)  # -0.0 + 0.0 is 0.0
    return hashlib.blake2s("".join(texts).encode(errors="replace"), digest_size=4).hexdigest()


def load_strategy(name: str, dotted: bool = False, deployed: DeployedModules | None = None) -> ConsensusAlgorithm:
    """Load the strategy ``name``: a built-in one, or an entry point of the group ``swarm_node.strategies``.

    The name ``deployed:x`` refers to the module ``x`` in ``deployed``, which an operator has deployed to the team. If
    ``dotted``, ``name`` may also be ``module:Class``.  Set this only for names in local settings, because a peer must
    not choose which modules this machine imports.  Raises ``UnknownStrategy``, whose text lists the known names.
    """
    if is_deployed(name):
        return _create_deployed(name, deployed or {})
    module, _, attribute = find_import_path(name, dotted).partition(":")
    try:
        strategy: ConsensusAlgorithm = getattr(importlib.import_module(module), attribute)()
    except Exception as error:  # third-party code may raise anything
        raise UnknownStrategy(f"strategy {name!r} cannot be loaded: {error}") from error
    return strategy


def find_import_path(name: str, dotted: bool = False) -> str:
    """Return the import path ``module:Class`` of a strategy without importing it; raises ``UnknownStrategy``."""
    target = name if dotted and ":" in name else BUILT_IN.get(name)
    if target is None:
        from importlib.metadata import entry_points  # this import is slow and rarely needed

        found = {point.name: point.value for point in entry_points(group=ENTRY_POINT_GROUP)}
        target = found.get(name)
        if target is None:
            raise UnknownStrategy(f"unknown strategy {name!r}; known: {', '.join(sorted(BUILT_IN | found))}")
    return target


def _range_error(number: float, lowest: float = 0.0) -> str:
    if type(number) is not float and type(number) is not int:
        return "must be a number"
    if lowest <= number <= MAX_NUMBER:
        return ""
    if number != number:
        return "is not a number"
    if number in (float("inf"), float("-inf")):
        return "is infinite"
    problem = "is negative" if lowest == 0.0 and number < 0.0 else f"exceeds {MAX_NUMBER:g} in magnitude"
    return f"{_format_number(number)} {problem}"


def _format_number(number: object) -> str:
    try:
        return f"{number:.3g}" if isinstance(number, float) else repr(number)[:40]
    except ValueError:  # an integer with thousands of digits
        return "an integer with thousands of digits"


def _sort_key(report: Report, rank: Callable[[Report], float]) -> tuple[object, ...]:
    return (rank(report), report.cost, _optional_fields(report), report.age, report.valid_for)


def _optional_fields(report: Report) -> str:
    given = (report.task, report.epoch, report.sequence, report.value, report.choice, report.weight, report.capacity)
    more = (report.battery, report.load, report.electorate)
    return "" if (given, more) == (("", 0, 0, (), "", 1.0, 1), (1.0, 0.0, 0.0)) else f"{given!r}{more!r};"


def _create_deployed(name: str, deployed: DeployedModules) -> ConsensusAlgorithm:
    make = find_factory(STRATEGY, name, deployed)
    try:
        strategy: ConsensusAlgorithm = make()
    except Exception as error:  # third-party code may raise anything
        raise UnknownStrategy(f"strategy {name!r} cannot be created: {error}") from error
    return strategy
