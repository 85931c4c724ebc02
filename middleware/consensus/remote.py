"""Remote: a strategy in another process, and the answers of one that runs in this process, as plain values; pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple
from typing import Any

from middleware.consensus.guard import NoOpinion
from middleware.consensus.item import Item
from middleware.consensus.strategy import Consensus, Report


class RemoteStrategy:
    """A strategy whose methods run elsewhere; each method raises what went wrong there."""

    def ask(self, method: str, arguments: list[Any]) -> Any:
        """The plain answer to one question."""
        raise NotImplementedError

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """The consensus point of the strategy."""
        return _consensus(self.ask("find", [astuple(r) for r in contacts]))

    def find_group(self, contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
        """The points of a strategy for several tasks; raises ``NotImplementedError`` for any other."""
        answer = self.ask("find_group", [[astuple(r) for r in contacts], [astuple(i) for i in items]])
        if answer is None:
            raise NotImplementedError
        if not isinstance(answer, list):
            raise NoOpinion(f"find_group answers {answer!r:.60}")
        return tuple(_consensus(point) for point in answer)

    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        """The answer of the strategy."""
        answer: bool = self.ask("improves", [astuple(current), astuple(offer), hysteresis])
        return answer

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """The summary of the strategy."""
        answer = self.ask("merge", [[astuple(r) for r in a], [astuple(r) for r in b]])
        try:
            return tuple(report_of(fields) for fields in answer)
        except TypeError as error:
            raise NoOpinion("merge answers no reports") from error


def answer(strategy: Any, method: str, arguments: list[Any]) -> Any:
    """The answer of ``strategy`` to one question of a ``RemoteStrategy``, as plain values."""
    if method == "find":
        return astuple(strategy.find([report_of(r) for r in arguments]))
    if method == "improves":
        return strategy.improves(report_of(arguments[0]), report_of(arguments[1]), arguments[2])
    if method == "find_group":
        if not hasattr(strategy, "find_group"):
            return None
        items = [Item(task, tuple(position), slots) for task, position, slots in arguments[1]]
        return [astuple(point) for point in strategy.find_group([report_of(r) for r in arguments[0]], items)]
    a, b = ([report_of(r) for r in part] for part in arguments)
    return [astuple(r) for r in strategy.merge(a, b)]


def report_of(fields: Sequence[Any]) -> Report:
    """A report out of what ``astuple`` made of it and a pipe carried."""
    return Report(*_fields(fields))


def _consensus(plain: Any) -> Consensus:
    try:
        return Consensus(*_fields(plain))
    except TypeError as error:
        raise NoOpinion(f"it answers {plain!r:.60}, not Consensus") from error


def _fields(values: Sequence[Any]) -> list[Any]:
    return [tuple(value) if isinstance(value, list) else value for value in values]
