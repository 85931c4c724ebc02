"""View: what a strategy sees of the members of a task; pure.

Records under the group's key and bids to the council are two ways of the same report, and both go through here: so a
strategy decides the same by either.  What it does not read is not shown to it, and is no part of the digest.

Not shown to any strategy is how old a report is, since each member would see another age: what is stale is left out
before (``agents.conference``).  So are reports of older rounds, and all but the newest of each member: ``epoch`` and
``sequence`` of a report stay 0.  Who lacks what the task requires takes no part in it: ``unmet`` stays empty.  A body
does one thing at a time: ``capacity`` stays 1.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from middleware.consensus.strategy import READABLE, Report, reads_of, refusal
from middleware.tasks.task import Member, is_bid, is_choice, is_value


class View:
    """The view of who goes by ``reads`` beside the cost (names out of ``strategy.READABLE``)."""

    def __init__(self, reads: Iterable[str] = ()) -> None:
        self.reads = tuple(name for name in READABLE if name in tuple(reads))

    def report(self, member: Member) -> Report | None:
        """What counts of what ``member`` tells; None where that is nothing."""
        if member.cost is None or not is_bid(member.cost):
            return None
        return Report(member.uuid, member.cost, **{name: _SHOWN[name](member) for name in self.reads})

    def told(self, member: Member, report: Report) -> Member:
        """``member`` as it would be had it told ``report``; unchanged where that is no lawful one."""
        if refusal(report) or not is_value(report.value) or not is_choice(report.choice):
            return member
        known: dict[str, Any] = {name: getattr(report, name) for name in self.reads if name != "load"}
        if "load" in self.reads:
            known["load"] = int(report.load) + 1
        return replace(member, cost=report.cost, **known)


def view_of(strategy: object) -> View:
    """What ``strategy`` sees."""
    return View(reads_of(strategy))


# As numbers of one kind: 1 and 1.0 are equal, and their digests are not.
_SHOWN: dict[str, Any] = {
    "battery": lambda member: float(member.battery),
    "load": lambda member: float(max(0, member.load - 1)),  # what it has beside this task
    "value": lambda member: tuple(map(float, member.value)),
    "choice": lambda member: member.choice,
    "weight": lambda member: float(member.weight),
    "electorate": lambda member: float(member.electorate),
}
