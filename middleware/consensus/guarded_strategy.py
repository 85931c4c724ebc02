"""Protect agents against faulty strategies.

A strategy that raises, times out or returns an invalid result is replaced by ``nearest`` for that decision, and the
reason says so.  Safety does not depend on this, because it rests on leases; the guard keeps the team working.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace

from twisted.logger import Logger

from middleware.consensus.assignment import Item, find_capacities, sort_items
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import (
    MAX_NAME,
    MAX_NUMBER,
    Consensus,
    ConsensusAlgorithm,
    Report,
    find_read_fields,
    refusal,
    standing,
)
from middleware.errors import SwarmError

MAX_REMEMBERED_RESULTS = 64
MAX_LOSSES = 3
"""A strategy that is lost this many times within ``LOSS_SPAN_CALLS`` calls is not called again.

Each loss costs a full deadline.
"""
LOSS_SPAN_CALLS = 10_000
"""Calls after which a loss is forgotten, about four minutes of a task: a busy machine is late now and then."""


class StrategyError(SwarmError):
    """A strategy's result is unusable; the text is the reason."""


class StrategyLost(StrategyError):
    """A strategy gave no result and its process was ended: it was late, sent too much, or died."""


class GuardedStrategy:
    """Call a strategy and fall back to ``nearest`` if it fails.

    With ``twice``, ``find`` is called a second time with the reports in another order, for third-party strategies.
    """

    log = Logger()

    def __init__(self, strategy: ConsensusAlgorithm, twice: bool = False) -> None:
        self.strategy = strategy
        self.name = str(getattr(strategy, "name", type(strategy).__name__))[:MAX_NAME]
        self.version = str(getattr(strategy, "version", ""))[:MAX_NAME]
        self.reads = find_read_fields(strategy)
        self.failure_reason = ""
        self._fallback = Nearest()
        self._is_called_twice = twice
        self._calls = 0
        self._losses: list[int] = []
        self._results: OrderedDict[tuple[Report, ...], Consensus] = OrderedDict()

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """Decide from the valid reports; the reason says if the fallback decided."""
        valid = _valid_reports(contacts)
        try:
            self._check_losses()
            found = check_consensus(self.strategy.find(valid), valid)
            known = self._results.setdefault(valid, found)
            if known != found or (
                self._is_called_twice and check_consensus(self.strategy.find(valid[::-1]), valid) != found
            ):
                raise StrategyError("it gives two results for equal reports")
            while len(self._results) > MAX_REMEMBERED_RESULTS:
                self._results.popitem(last=False)
        except Exception as error:  # third-party code may raise anything
            why = self._record_failure(error)
            fallback = self._fallback.find(valid)
            reason = f"{self.name} has no opinion ({why}); {self._fallback.name}: {fallback.reason}"
            return replace(fallback, strategy=self._fallback.name, reason=reason)
        return replace(found, strategy=self.name)

    def find_group(self, contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
        """Decide all items.

        A strategy without ``find_group``, and the fallback, decide the items one after another.
        """
        valid = _valid_reports(contacts)
        find_group = getattr(self.strategy, "find_group", None)
        if find_group is None:
            return decide_one_by_one(self.find, valid, items)
        try:
            self._check_losses()
            found = check_group(find_group(valid, items), valid, items)
        except NotImplementedError:
            return decide_one_by_one(self.find, valid, items)
        except Exception as error:  # third-party code may raise anything
            reason = f"{self.name} has no opinion ({self._record_failure(error)}); {self._fallback.name}: "
            found = decide_one_by_one(self._fallback.find, valid, items)
            return tuple(replace(p, strategy=self._fallback.name, reason=reason + p.reason) for p in found)
        return tuple(replace(point, strategy=self.name) for point in found)

    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        """Return whether ``offer`` should take over; the fallback decides if the strategy fails."""
        if refusal(offer):
            return False
        try:
            self._check_losses()
            answer = self.strategy.improves(current, offer, hysteresis)
            if not isinstance(answer, bool):
                raise StrategyError(f"improves returns {type(answer).__name__}, not bool")
        except Exception as error:  # third-party code may raise anything
            self._record_failure(error)
            return self._fallback.improves(current, offer, hysteresis)
        return answer

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """Return a summary of the valid reports of both; the fallback's if the strategy returns other reports."""
        valid = _valid_reports((*a, *b))
        try:
            self._check_losses()
            merged = self.strategy.merge(valid, ())
            if not isinstance(merged, tuple) or len(merged) > len(valid) or not set(merged) <= set(valid):
                raise StrategyError("merge returns reports that were not given")
        except Exception as error:  # third-party code may raise anything
            self._record_failure(error)
            return self._fallback.merge(valid, ())
        return merged

    def stop(self) -> None:
        """Stop the strategy's process, if it has one."""
        stop = getattr(self.strategy, "stop", None)
        if stop is not None:
            stop()

    def _check_losses(self) -> None:
        if len(self._losses) >= MAX_LOSSES:
            raise StrategyError(f"it gave no result {MAX_LOSSES} times and is not called again")
        self._calls += 1

    def _record_failure(self, error: Exception) -> str:
        """Count and log a failure, and return it in one line; the same failure is not logged again."""
        if isinstance(error, StrategyLost):
            self._losses = [*(each for each in self._losses if self._calls - each < LOSS_SPAN_CALLS), self._calls]
        text = str(error) if isinstance(error, StrategyError) else f"{type(error).__name__}: {error}"
        # the last line of a trace is the exception
        why = (text.strip().splitlines() or ["no error text"])[-1][:MAX_NAME]
        if why != self.failure_reason:
            self.failure_reason = why
            self.log.failure("strategy {name} has no opinion: {why}", name=self.name, why=why)
        return why


def check_consensus(found: Consensus, contacts: Sequence[Report]) -> Consensus:
    """Return ``found`` if it is a possible decision for ``contacts``; raise ``StrategyError`` otherwise."""
    if not isinstance(found, Consensus):
        raise StrategyError(f"find returns {type(found).__name__}, not Consensus")
    agents = {report.agent for report in contacts}
    named = () if found.assigned_agent is None else (found.assigned_agent,)
    for group in (found.standby, found.assigned, found.value):
        if not isinstance(group, tuple) or len(group) > max(8, len(agents)):
            raise StrategyError("it names more agents or numbers than allowed")
    for agent in (*named, *found.standby, *found.assigned):
        if agent not in agents:
            raise StrategyError(f"it names {agent!r:.60}, which did not report")
    if len({*named, *found.standby}) < len(named) + len(found.standby):
        raise StrategyError("it names an agent twice")
    for text in (found.digest, found.task, found.choice, found.strategy, found.reason):
        if not isinstance(text, str) or len(text) > 2 * MAX_NAME:
            raise StrategyError("a text of its result is too long")
    if not all(type(n) in (int, float) and -MAX_NUMBER <= n <= MAX_NUMBER for n in found.value):
        raise StrategyError("its value is not a tuple of valid numbers")
    return found


def check_group(found: Sequence[Consensus], contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
    """Return ``found`` if it has one possible decision per item within all capacities; else raise ``StrategyError``."""
    if not isinstance(found, tuple) or not all(isinstance(point, Consensus) for point in found):
        raise StrategyError("find_group does not return a tuple of Consensus")
    if [point.task for point in found] != [item.task for item in sort_items(items)]:
        raise StrategyError("find_group does not return one decision for each task")
    wanted = {"", *(item.task for item in items)}
    capacity_left = find_capacities(report for report in standing(contacts) if report.task in wanted)
    for point in found:
        check_consensus(point, [report for report in contacts if report.task in (point.task, "")])
        for agent in {*point.assigned, *filter(None, (point.assigned_agent,))}:
            capacity_left[agent] = capacity_left.get(agent, 0) - 1
    if overloaded := sorted(agent for agent, remaining in capacity_left.items() if remaining < 0):
        raise StrategyError(f"it gives {overloaded[0]!r:.60} more tasks than its capacity")
    return found


def decide_one_by_one(
    find: Callable[[Sequence[Report]], Consensus], contacts: Sequence[Report], items: Sequence[Item]
) -> tuple[Consensus, ...]:
    """Decide the items separately, sorted by task name; agents whose capacity is used up are left out."""
    counted = standing(contacts)
    capacity_left = find_capacities(counted)
    points = []
    for item in sort_items(items):
        free = [replace(r, task=item.task) for r in counted if r.task in (item.task, "") and capacity_left[r.agent] > 0]
        point = replace(find(free), task=item.task, epoch=counted[0].epoch if counted else 0)
        if point.assigned_agent is not None:
            capacity_left[point.assigned_agent] -= 1
        points.append(point)
    return tuple(points)


def _valid_reports(contacts: Sequence[Report]) -> tuple[Report, ...]:
    """Return the valid reports in an order that does not depend on the given one."""
    return tuple(sorted((r for r in contacts if not refusal(r)), key=_sort_key))


def _sort_key(report: Report) -> tuple[object, ...]:
    return (report.task, report.agent, report.epoch, report.sequence, report.cost, repr(report))
