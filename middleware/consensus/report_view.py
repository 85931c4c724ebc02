"""The part of the members' reports that a strategy sees; pure.

Records under the task's key and bids to the quorum members carry the same reports, and both pass through here: the
decision does not depend on the path.  Fields that the strategy does not read are hidden from it and are not part of the
digest.

The age of a report is never shown, because each member would see another age; stale reports are removed earlier
(``agents.decider``).  Reports of older rounds, and all but the newest of each member, are removed too: ``epoch`` and
``sequence`` of a report stay 0.  A device that does not meet the task's requirements takes no part: ``unmet`` stays
empty.  A device does one task at a time: ``capacity`` stays 1.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from middleware.consensus.strategy import READABLE, Report, find_read_fields, refusal
from middleware.tasks.task import Member, is_bid, is_choice, is_value


class ReportView:
    """The view of a strategy that reads ``reads`` (names out of ``strategy.READABLE``) besides the cost."""

    def __init__(self, reads: Iterable[str] = ()) -> None:
        self.reads = tuple(name for name in READABLE if name in tuple(reads))

    def make_report(self, member: Member) -> Report | None:
        """Return the report that the strategy sees of ``member``; None if the member has reported no valid cost."""
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


# Numbers are converted to one type: 1 and 1.0 are equal but have different digests.
_READERS: dict[str, Any] = {
    "battery": lambda member: float(member.battery),
    "load": lambda member: float(max(0, member.load - 1)),  # tasks besides this one
    "value": lambda member: tuple(map(float, member.value)),
    "choice": lambda member: member.choice,
    "weight": lambda member: float(member.weight),
    "electorate": lambda member: float(member.electorate),
}
