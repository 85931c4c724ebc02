"""Decision: the rule between reports and deeds (Algorithm 4.5, revised); pure.

The reports of all present members go in; who is assigned comes out, or why there is nobody yet.  It is taken again at
every change: a member that left or came, a report, an assigned agent that goes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from middleware.consensus.strategy import ConsensusAlgorithm, Report
from middleware.presence import EXECUTING
from middleware.tasks import Member


@dataclass(frozen=True)
class Decision:
    """Who is ``assigned`` (a uuid, or None), a ``digest`` of the reports used, and ``why`` in a person's words."""

    assigned: str | None
    digest: str
    why: str


def decide(
    members: Iterable[Member],
    strategy: ConsensusAlgorithm,
    hysteresis: float,
    waiting_period: float,
    since_first: float | None,
) -> Decision:
    """The consensus point of ``members``.

    ``since_first`` is the seconds since the first report was seen, None when there is none.  Within the waiting period
    nobody is assigned, unless everybody has reported or somebody acts already; whoever acts keeps the task until
    another is better by the ``hysteresis``.
    """
    present = {m.uuid: m for m in members}
    reports = {m.uuid: Report(m.uuid, m.cost) for m in present.values() if m.cost is not None}
    if not reports or since_first is None:
        return Decision(None, "", "nobody has reported yet")
    acting = sorted(m.uuid for m in present.values() if m.status == EXECUTING and m.uuid in reports)
    if len(reports) < len(present) and since_first < waiting_period and not acting:
        missing = sorted(m.name for m in present.values() if m.uuid not in reports)
        return Decision(None, "", f"waiting for {', '.join(missing)}")
    consensus = strategy.find(list(reports.values()))
    best = consensus.assigned_agent
    if best is None:
        return Decision(None, consensus.digest, "no report counts")
    if acting and best not in acting:
        current = min((reports[uuid] for uuid in acting), key=lambda r: (r.cost, r.agent))
        if not strategy.improves(current, reports[best], hysteresis):
            best = current.agent
    elif acting:
        best = min((reports[uuid] for uuid in acting), key=lambda r: (r.cost, r.agent)).agent
    name, cost = present[best].name, reports[best].cost
    return Decision(best, consensus.digest, f"{name}, {cost:.2f}, best of {len(reports)}")
