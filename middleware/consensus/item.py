"""Item: one of several tasks that are shared out at once, and what a strategy for several promises."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Consensus, Report, digest_of, standing

QUANTUM = 1_000_000
"""Costs are compared as whole millionths, so that sums are exact and equal everywhere."""


@dataclass(frozen=True, slots=True)
class Item:
    """A task as strategies for several see it: ``position`` in metres where it matters, ``slots`` agents act."""

    task: str
    position: tuple[float, ...] = ()
    slots: int = 1


class Sharing(Nearest):
    """What the strategies for several tasks have in common; each brings its own ``find_group``."""

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """The consensus point of the first task by name."""
        found = self.find_group(contacts, items_of(standing(contacts)))
        return found[0] if found else super().find(contacts)

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """All reports that count of both: each may matter."""
        return standing((*a, *b))

    def find_group(self, contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
        """One consensus point for each item, in the order of their names; nobody acts for more than its capacity."""
        raise NotImplementedError


def items_of(contacts: Iterable[Report]) -> list[Item]:
    """The tasks that the reports are about, where nobody says more about them."""
    return [Item(task) for task in sorted({r.task for r in contacts if isinstance(r.task, str)})]


def listed(items: Iterable[Item]) -> list[Item]:
    """Each task once, by name."""
    return sorted({item.task: item for item in items}.values(), key=lambda item: item.task)


def exact(cost: float) -> int:
    """A cost in whole millionths."""
    return round(cost * QUANTUM)


def capacities(contacts: Iterable[Report]) -> dict[str, int]:
    """How many tasks each agent takes; where its reports differ, the least it says."""
    most: dict[str, int] = {}
    for report in contacts:
        most[report.agent] = min(report.capacity, most.get(report.agent, report.capacity))
    return dict(sorted(most.items()))


def shared_out(
    name: str, counted: Sequence[Report], items: Sequence[Item], owners: Mapping[str, Sequence[str]]
) -> tuple[Consensus, ...]:
    """The consensus points of an assignment: who has each task, and who else bid for it, the cheapest first.

    ``counted`` are the reports that stand.
    """
    epoch = counted[0].epoch if counted else 0
    digest = digest_of(counted) if counted else ""
    bids: dict[str, list[Report]] = {}
    for report in counted:
        bids.setdefault(report.task, []).append(report)
    points = []
    agents = len({r.agent for r in counted})
    for item in listed(items):
        chosen = tuple(owners.get(item.task, ()))
        order = sorted(bids.get(item.task, []), key=lambda r: (r.cost, r.agent))
        standby = tuple(r.agent for r in order if r.agent not in chosen)[:15]
        reason = f"divided with {len(items) - 1} other{'s' * (len(items) != 2)} among {agents}"
        if not chosen:
            reason = "nobody bid for it" if not order else "everybody who bid for it has enough to do"
        points.append(
            Consensus(
                chosen[0] if chosen else None, standby, digest, item.task, epoch, chosen, strategy=name, reason=reason
            )
        )
    return tuple(points)
