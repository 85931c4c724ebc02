"""The part of the members' reports that a strategy gets; pure.

Reports arrive in records under the task's key and in bids.  Both pass through this module, so the decision does not
depend on the way in which a report arrives.  Fields that the strategy does not read are hidden from it and are not part
of the digest.

Some fields of a report always have their default value here.  ``age`` is hidden, because it would be different at each
member; stale reports are removed earlier (``agents.decider``).  ``epoch`` and ``sequence`` are 0, because only the
newest report of each member in the current round is used.  ``unmet`` is empty, because a device that does not meet the
task's requirements does not participate.  ``capacity`` is 1, because a device does one task at a time.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from middleware.consensus.strategy import READABLE, Report, find_read_fields, refusal
from middleware.tasks.task import Member, is_bid, is_choice, is_value


class ReportView:
    """The view of a strategy that reads the fields ``reads`` (of ``strategy.READABLE``) in addition to the cost."""

    def __init__(self, reads: Iterable[str] = ()) -> None:
        self.reads = tuple(name for name in READABLE if name in tuple(reads))

    def make_report(self, member: Member) -> Report | None:
        """Return the report of ``member`` for the strategy; None if the member has not reported a valid cost."""
        if member.cost is None or not is_bid(member.cost):
            return None
        return Report(member.uuid, member.cost, **{name: _READERS[name](member) for name in self.reads})

    def apply_report(self, member: Member, report: Report) -> Member:
        """Return ``member`` with the values of ``report``; unchanged if the report is invalid."""
        if refusal(report) or not is_value(report.value) or not is_choice(report.choice):
            return member
        known: dict[str, Any] = {name: getattr(report, name) for name in self.reads if name != "load"}
        if "load" in self.reads:
            known["load"] = int(report.load) + 1
        return replace(member, cost=report.cost, **known)


def make_view(strategy: object) -> ReportView:
    """Return the view of ``strategy``."""
    return ReportView(find_read_fields(strategy))


# Numbers are converted to float, because 1 and 1.0 are equal but have different digests.
_READERS: dict[str, Any] = {
    "battery": lambda member: float(member.battery),
    "load": lambda member: float(max(0, member.load - 1)),  # the load is the number of tasks in addition to this one
    "value": lambda member: tuple(map(float, member.value)),
    "choice": lambda member: member.choice,
    "weight": lambda member: float(member.weight),
    "electorate": lambda member: float(member.electorate),
}
