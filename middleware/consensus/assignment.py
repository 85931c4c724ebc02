"""Base class and data of strategies that assign several tasks jointly."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Consensus, Report, digest_of, standing

COST_SCALE = 1_000_000
"""Costs are converted to whole millionths, so that their sums are exact and equal at all nodes."""


@dataclass(frozen=True, slots=True)
class Item:
    """A task to assign, with its ``position`` in metres (may be empty) and the number of acting agents (``slots``)."""

    task: str
    position: tuple[float, ...] = ()
    slots: int = 1


class MultiTaskStrategy(Nearest):
    """Base class of strategies that assign several tasks jointly; subclasses implement ``find_group``."""

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """Decide the task with the lowest id."""
        found = self.find_group(contacts, list_items(standing(contacts)))
        return found[0] if found else super().find(contacts)

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """Return all valid reports in ``a`` and ``b``, because each report may affect the assignment."""
        return standing((*a, *b))

    def find_group(self, contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
        """Return one decision for each item, sorted by task id; no agent gets more tasks than its capacity."""
        raise NotImplementedError


def list_items(contacts: Iterable[Report]) -> list[Item]:
    """Return the tasks of the reports, as items without positions."""
    return [Item(task) for task in sorted({r.task for r in contacts if isinstance(r.task, str)})]


def sort_items(items: Iterable[Item]) -> list[Item]:
    """Return the items without duplicates, sorted by task id."""
    return sorted({item.task: item for item in items}.values(), key=lambda item: item.task)


def to_millionths(cost: float) -> int:
    """Return a cost in whole millionths."""
    return round(cost * COST_SCALE)


def find_capacities(contacts: Iterable[Report]) -> dict[str, int]:
    """Return the number of tasks that each agent accepts: the lowest capacity in the reports of the agent."""
    most: dict[str, int] = {}
    for report in contacts:
        most[report.agent] = min(report.capacity, most.get(report.agent, report.capacity))
    return dict(sorted(most.items()))


def build_decisions(
    name: str, counted: Sequence[Report], items: Sequence[Item], owners: Mapping[str, Sequence[str]]
) -> tuple[Consensus, ...]:
    """Build the decisions of an assignment; the bidders that are not assigned become standbys, the cheapest first.

    ``owners`` are the agents assigned to each task; ``counted`` are the valid reports.
    """
    epoch = counted[0].epoch if counted else 0
    digest = digest_of(counted) if counted else ""
    bids: dict[str, list[Report]] = {}
    for report in counted:
        bids.setdefault(report.task, []).append(report)
    points = []
    agents = len({r.agent for r in counted})
    for item in sort_items(items):
        chosen = tuple(owners.get(item.task, ()))
        order = sorted(bids.get(item.task, []), key=lambda r: (r.cost, r.agent))
        standby = tuple(r.agent for r in order if r.agent not in chosen)[:15]
        reason = f"assigned with {len(items) - 1} other task{'s' * (len(items) != 2)} among {agents} agents"
        if not chosen:
            reason = "no agent bid for the task" if not order else "all bidders have reached their capacity"
        points.append(
            Consensus(
                chosen[0] if chosen else None, standby, digest, item.task, epoch, chosen, strategy=name, reason=reason
            )
        )
    return tuple(points)
