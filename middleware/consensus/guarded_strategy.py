"""Protect agents against faulty strategies.

If a strategy raises an exception, times out or returns an invalid result, ``nearest`` makes that decision instead, and
the reason of the decision describes the failure.  Safety does not depend on the guard, because only a lease gives the
right to act; the guard lets the team continue its work.
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
"""Number of losses (``StrategyLost``) within ``LOSS_SPAN_CALLS`` calls after which a strategy is not called again.

Each loss blocks the node for the full deadline of a call.
"""
LOSS_SPAN_CALLS = 10_000
"""Number of calls after which a loss is forgotten, about four minutes of a task.  On a busy machine, calls are
sometimes late."""


class StrategyError(SwarmError):
    """The result of a strategy is unusable; the text is the reason."""


class StrategyLost(StrategyError):
    """A strategy gave no result: it was late, sent too much data, or its process ended."""


class GuardedStrategy:
    """Calls a strategy, and uses ``nearest`` instead if the strategy fails.

    ``twice`` is for third-party strategies: ``find`` is then called a second time with the reports in a different
    order, and both results must be equal.
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
        """Return the decision for the valid reports; if the fallback made it, its reason describes the failure."""
        valid = _valid_reports(contacts)
        try:
            self._check_losses()
            found = check_consensus(self.strategy.find(valid), valid)
            known = self._results.setdefault(valid, found)
            if known != found or (
                self._is_called_twice and check_consensus(self.strategy.find(valid[::-1]), valid) != found
            ):
                raise StrategyError("find returns different results for equal reports")
            while len(self._results) > MAX_REMEMBERED_RESULTS:
                self._results.popitem(last=False)
        except Exception as error:  # third-party code may raise anything
            why = self._record_failure(error)
            fallback = self._fallback.find(valid)
            reason = f"{self.name} failed ({why}); {self._fallback.name}: {fallback.reason}"
            return replace(fallback, strategy=self._fallback.name, reason=reason)
        return replace(found, strategy=self.name)

    def find_group(self, contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
        """Return one decision for each item.

        If the strategy has no ``find_group``, or fails, the items are decided one after another.
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
            reason = f"{self.name} failed ({self._record_failure(error)}); {self._fallback.name}: "
            found = decide_one_by_one(self._fallback.find, valid, items)
            return tuple(replace(p, strategy=self._fallback.name, reason=reason + p.reason) for p in found)
        return tuple(replace(point, strategy=self.name) for point in found)

    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        """Return whether the agent of ``offer`` should take over; if the strategy fails, the fallback decides."""
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
        """Return a summary of the valid reports in ``a`` and ``b``; if the strategy fails, the fallback's summary."""
        valid = _valid_reports((*a, *b))
        try:
            self._check_losses()
            merged = self.strategy.merge(valid, ())
            if not isinstance(merged, tuple) or len(merged) > len(valid) or not set(merged) <= set(valid):
                raise StrategyError("merge returned reports that are not among its arguments")
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
            raise StrategyError(f"the strategy gave no result {MAX_LOSSES} times and is not called again")
        self._calls += 1

    def _record_failure(self, error: Exception) -> str:
        """Log a failure, and return it as one line; the same failure is not logged again."""
        if isinstance(error, StrategyLost):
            self._losses = [*(each for each in self._losses if self._calls - each < LOSS_SPAN_CALLS), self._calls]
        text = str(error) if isinstance(error, StrategyError) else f"{type(error).__name__}: {error}"
        # the last line of a traceback is the exception
        why = (text.strip().splitlines() or ["no error text"])[-1][:MAX_NAME]
        if why != self.failure_reason:
            self.failure_reason = why
            self.log.failure("strategy {name} failed; nearest is used instead: {why}", name=self.name, why=why)
        return why


def check_consensus(found: Consensus, contacts: Sequence[Report]) -> Consensus:
    """Return ``found`` if it is a possible decision for ``contacts``; raise ``StrategyError`` otherwise."""
    if not isinstance(found, Consensus):
        raise StrategyError(f"find returns {type(found).__name__}, not Consensus")
    agents = {report.agent for report in contacts}
    named = () if found.assigned_agent is None else (found.assigned_agent,)
    for group in (found.standby, found.assigned, found.value):
        if not isinstance(group, tuple) or len(group) > max(8, len(agents)):
            raise StrategyError("find returns too many agents or numbers")
    for agent in (*named, *found.standby, *found.assigned):
        if agent not in agents:
            raise StrategyError(f"find returns the agent {agent!r:.60}, which did not report")
    if len({*named, *found.standby}) < len(named) + len(found.standby):
        raise StrategyError("find returns an agent twice")
    for text in (found.digest, found.task, found.choice, found.strategy, found.reason):
        if not isinstance(text, str) or len(text) > 2 * MAX_NAME:
            raise StrategyError("a string in the result of find is too long")
    if not all(type(n) in (int, float) and -MAX_NUMBER <= n <= MAX_NUMBER for n in found.value):
        raise StrategyError("the value in the result of find is not a tuple of valid numbers")
    return found


def check_group(found: Sequence[Consensus], contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
    """Return ``found`` if it is a possible decision per item, within all capacities; else raise ``StrategyError``."""
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
        raise StrategyError(f"find_group assigns to {overloaded[0]!r:.60} more tasks than its capacity")
    return found


def decide_one_by_one(
    find: Callable[[Sequence[Report]], Consensus], contacts: Sequence[Report], items: Sequence[Item]
) -> tuple[Consensus, ...]:
    """Decide the items one after another, sorted by task id; skip agents without remaining capacity."""
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
    """Return the valid reports in a defined order."""
    return tuple(sorted((r for r in contacts if not refusal(r)), key=_sort_key))


def _sort_key(report: Report) -> tuple[object, ...]:
    return (report.task, report.agent, report.epoch, report.sequence, report.cost, repr(report))
