"""Strategy: who should act.  Pure, replaceable, loaded by name; it may be wrong, and then only the choice suffers.

A strategy sees the reports of the agents assigned to a task and names the one that should act (thesis, section 4.2.5
and Algorithm 4.5: ``consensus.find(contacts)``, ``consensus.assigned_agent``).  Who may act is not its business
(``lease``).
"""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from middleware.consensus.deployed import STRATEGY, Deployed, is_deployed, maker_of
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
ENTRY_POINTS = "swarm_node.strategies"
MAX_NUMBER = 1e9
"""What is beyond it is no cost, place or weight of anything on this planet, and adds up without loss."""
MAX_WHOLE = 2**53
MAX_NAME = 200
READABLE = ("battery", "load", "value", "choice", "weight", "electorate")
"""What a strategy may go by beside the cost.  In ``reads`` it says what of it; who does not say is given all."""
SHOWN = 40
LABELS = ("cost", "weight", "electorate", "load", "age", "valid_for")


@dataclass(frozen=True, slots=True)
class Report:
    """One agent's report: ``agent`` is its uuid, ``cost`` what acting would cost it (for ``nearest``: metres).

    ``task`` and ``epoch`` say what the report is about; of several epochs only the newest counts.  ``unmet`` names the
    requirements that the device does not meet.  ``age`` is how many seconds ago it was measured and ``valid_for`` how
    many it holds (0: as long as the agent is there), both durations, since no two clocks agree.  ``value`` is a number
    or a place, in metres (``average``, ``rendezvous``; for ``sequential`` where the agent stands), ``choice`` a vote
    and ``sequence`` its number, ``weight`` counts for both and ``electorate`` is the weight of all that may vote,
    ``capacity`` is how many tasks the agent would take, ``battery`` the share that is left and ``load`` how many tasks
    it has already.
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
    """The consensus point: who should act, those that stand by in order, and a digest of the reports used.

    ``assigned`` are all that act where a task has several places, ``value`` is what was agreed on by number or place
    and ``choice`` by vote; ``strategy`` and ``reason`` are for people and make no difference.
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
    """What a strategy is.  Each method is a pure function; equal reports in any order give an equal result.

    It may also have ``reads``, the names among ``READABLE`` of what it goes by beside the cost.
    """

    name: str
    version: str

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """The consensus point of the reports of all contacts, oneself included."""

    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        """Whether ``offer`` is so much better than ``current`` that the task should change hands."""

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """A summary of both: the order, grouping and repetition of merges never show, and ``find`` of it is theirs."""


def refusal(report: Report) -> str:
    """Why a report counts for nothing, or "" where it is lawful."""
    if not isinstance(report.agent, str) or not 0 < len(report.agent) <= MAX_NAME:
        return "the agent has no name, or too long a one"
    numbers = (report.cost, report.weight, report.electorate, report.load, report.age, report.valid_for)
    if not all((type(n) is float or type(n) is int) and 0.0 <= n <= MAX_NUMBER for n in numbers):
        for label, number in zip(LABELS, numbers, strict=True):
            if why := _unlawful(number):
                return f"{label} {why}"
    if not isinstance(report.value, tuple) or len(report.value) > 8:
        return "value is no place"
    for number in report.value:
        if why := _unlawful(number, lowest=-MAX_NUMBER):
            return f"value {why}"
    if type(report.battery) not in (float, int) or not 0.0 <= report.battery <= 1.0:
        return f"battery {_told(report.battery)} is no share"
    for whole in (report.epoch, report.sequence, report.capacity):
        if type(whole) is not int or not 0 <= whole < MAX_WHOLE:
            return f"{_told(whole)} is no epoch, sequence or capacity"
    for text in (report.task, report.choice):
        if not isinstance(text, str) or len(text) > MAX_NAME:
            return "task or choice is no text, or too long"
    if report.unmet:
        return "cannot do it: " + ", ".join(map(str, report.unmet))[:MAX_NAME]
    if 0.0 < report.valid_for < report.age:
        return f"stale: {report.age:g} s old, valid for {report.valid_for:g} s"
    return ""


def cost_of(report: Report) -> float:
    """What most strategies rank by."""
    return report.cost


def standing(contacts: Iterable[Report], rank: Callable[[Report], float] = cost_of) -> tuple[Report, ...]:
    """The reports that count: lawful, of the newest epoch, one of each agent and task, by task and agent.

    Within an epoch a bid only ever improves, so of several of one agent that of the lowest ``rank`` stands.  This is a
    join: it makes no difference who merged what first, or twice.
    """
    lawful = [r for r in contacts if not refusal(r)]
    epoch = max((r.epoch for r in lawful), default=0)
    best: dict[tuple[str, str], Report] = {}
    for report in lawful:
        if report.epoch == epoch:
            known = best.setdefault((report.task, report.agent), report)
            if known is not report and _order(report, rank) < _order(known, rank):
                best[report.task, report.agent] = report
    return tuple(best[key] for key in sorted(best))


def led_by(
    name: str,
    order: Sequence[Report],
    counted: Sequence[Report],
    reason: str,
    value: tuple[float, ...] = (),
    choice: str = "",
) -> Consensus:
    """What the strategy ``name`` finds: the first of ``order`` acts, the others stand by; without an order nobody does.

    ``counted`` are the reports used, at least one, all of one task and epoch.
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


def reads_of(strategy: object) -> tuple[str, ...]:
    """What ``strategy`` goes by beside the cost, in the order of ``READABLE``; everything where it does not say."""
    try:
        said = tuple(getattr(strategy, "reads", READABLE))
        return tuple(name for name in READABLE if name in said)
    except Exception:  # the strategy is foreign code
        return READABLE


def agreement(value: tuple[float, ...], choice: str) -> str:
    """What was agreed on by number, place or vote, as people read it; "" where nothing was."""
    if choice:
        return choice[:SHOWN]
    if len(value) == 1:
        return f"{value[0]:.2f}"
    return f"({', '.join(f'{number:.2f}' for number in value)})" if value else ""


def digest_of(contacts: Iterable[Report]) -> str:
    """Eight hex digits that are equal for equal reports, whatever their order."""
    texts = sorted(f"{r.agent}={r.cost + 0.0:.6f};{_rest(r)}" for r in contacts)  # -0.0 is 0.0
    return hashlib.blake2s("".join(texts).encode(errors="replace"), digest_size=4).hexdigest()


def strategy_for(name: str, dotted: bool = False, deployed: Deployed | None = None) -> ConsensusAlgorithm:
    """The strategy called ``name``: a built-in one, or an entry point of ``swarm_node.strategies``.

    ``deployed:x`` is the module ``x`` that an operator pushed, among those in ``deployed``.

    With ``dotted`` also ``module:Class``, for names out of this machine's own settings: what a peer sends must never
    say what is imported here.  Raises ``UnknownStrategy``, which names those that there are.
    """
    if is_deployed(name):
        return _deployed(name, deployed or {})
    module, _, attribute = place_of(name, dotted).partition(":")
    try:
        strategy: ConsensusAlgorithm = getattr(importlib.import_module(module), attribute)()
    except Exception as error:  # a module of somebody else may fail in any way
        raise UnknownStrategy(f"strategy {name!r} cannot be loaded: {error}") from error
    return strategy


def place_of(name: str, dotted: bool = False) -> str:
    """Where that strategy lies, ``module:Class``, without importing it; raises ``UnknownStrategy``."""
    target = name if dotted and ":" in name else BUILT_IN.get(name)
    if target is None:
        from importlib.metadata import entry_points  # heavy, and most nodes never come here

        found = {point.name: point.value for point in entry_points(group=ENTRY_POINTS)}
        target = found.get(name)
        if target is None:
            raise UnknownStrategy(f"no strategy is called {name!r}; there are {', '.join(sorted(BUILT_IN | found))}")
    return target


def _unlawful(number: float, lowest: float = 0.0) -> str:
    if type(number) is not float and type(number) is not int:
        return "is no number"
    if lowest <= number <= MAX_NUMBER:
        return ""
    if number != number:
        return "is not a number"
    if number in (float("inf"), float("-inf")):
        return "is infinite"
    return f"{_told(number)} is negative" if lowest == 0.0 and number < 0.0 else f"{_told(number)} is enormous"


def _told(number: object) -> str:
    try:
        return f"{number:.3g}" if isinstance(number, float) else repr(number)[:40]
    except ValueError:  # a whole number of thousands of digits
        return "a number of thousands of digits"


def _order(report: Report, rank: Callable[[Report], float]) -> tuple[object, ...]:
    return (rank(report), report.cost, _rest(report), report.age, report.valid_for)


def _rest(report: Report) -> str:
    given = (report.task, report.epoch, report.sequence, report.value, report.choice, report.weight, report.capacity)
    more = (report.battery, report.load, report.electorate)
    return "" if (given, more) == (("", 0, 0, (), "", 1.0, 1), (1.0, 0.0, 0.0)) else f"{given!r}{more!r};"


def _deployed(name: str, deployed: Deployed) -> ConsensusAlgorithm:
    make = maker_of(STRATEGY, name, deployed)
    try:
        strategy: ConsensusAlgorithm = make()
    except Exception as error:  # a module of somebody else may fail in any way
        raise UnknownStrategy(f"strategy {name!r} cannot be made: {error}") from error
    return strategy
