"""Calls of a strategy in another process, with arguments and results as plain values; pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple
from typing import Any

from middleware.consensus.assignment import Item
from middleware.consensus.guarded_strategy import StrategyError
from middleware.consensus.strategy import Consensus, Report


class RemoteStrategy:
    """A strategy in another process; each method raises ``StrategyError`` if the call fails there."""

    def call(self, method: str, arguments: list[Any]) -> Any:
        """Call ``method`` in the other process and return its result as plain values."""
        raise NotImplementedError

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """Return the decision, made in the other process."""
        return _consensus_from(self.call("find", [astuple(r) for r in contacts]))

    def find_group(self, contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
        """Return the decisions for all items, made in the other process.

        Raises ``NotImplementedError`` if the strategy can only decide single tasks.
        """
        answer = self.call("find_group", [[astuple(r) for r in contacts], [astuple(i) for i in items]])
        if answer is None:
            raise NotImplementedError
        if not isinstance(answer, list):
            raise StrategyError(f"find_group returns {answer!r:.60}, not a tuple of Consensus")
        return tuple(_consensus_from(point) for point in answer)

    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        """Compare two reports, in the other process."""
        answer: bool = self.call("improves", [astuple(current), astuple(offer), hysteresis])
        return answer

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """Summarise reports, in the other process."""
        answer = self.call("merge", [[astuple(r) for r in a], [astuple(r) for r in b]])
        try:
            return tuple(make_report(fields) for fields in answer)
        except TypeError as error:
            raise StrategyError("merge does not return a tuple of Report") from error


def run_call(strategy: Any, method: str, arguments: list[Any]) -> Any:
    """Run one call of a ``RemoteStrategy`` on ``strategy`` and return the result as plain values."""
    if method == "find":
        return astuple(strategy.find([make_report(r) for r in arguments]))
    if method == "improves":
        return strategy.improves(make_report(arguments[0]), make_report(arguments[1]), arguments[2])
    if method == "find_group":
        if not hasattr(strategy, "find_group"):
            return None
        items = [Item(task, tuple(position), slots) for task, position, slots in arguments[1]]
        return [astuple(point) for point in strategy.find_group([make_report(r) for r in arguments[0]], items)]
    a, b = ([make_report(r) for r in part] for part in arguments)
    return [astuple(r) for r in strategy.merge(a, b)]


def make_report(fields: Sequence[Any]) -> Report:
    """Create a report from its values as returned by ``astuple``."""
    return Report(*_tuples_from_lists(fields))


def _consensus_from(plain: Any) -> Consensus:
    try:
        return Consensus(*_tuples_from_lists(plain))
    except TypeError as error:
        raise StrategyError(f"find returns {plain!r:.60}, not Consensus") from error


def _tuples_from_lists(values: Sequence[Any]) -> list[Any]:
    return [tuple(value) if isinstance(value, list) else value for value in values]
