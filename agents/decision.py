"""The decision rule between reports and actions (Algorithm 4.5, revised); pure.

The input is the reports of all present members; the output is the assigned agent, or the reason why no agent is
assigned yet. An agent decides again after each change: a member joins or leaves, or a report arrives.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from middleware.consensus.bidding.reporters import ANNOUNCEMENT_TIMEOUT_S
from middleware.consensus.report_view import make_view
from middleware.consensus.strategy import Consensus, ConsensusAlgorithm, Report, format_agreement
from middleware.directory.presence import EXECUTING
from middleware.tasks.task import Member

MAX_REASON_CHARS = 100
"""Maximum characters of a strategy's reason for assigning no agent; every report contains this reason."""


@dataclass(frozen=True)
class Decision:
    """The result of one decision.

    - ``assigned``: the uuid of the agent that should act, or None
    - ``digest``: the digest of the reports used
    - ``why``: the reason, for display
    - ``order``: all agents that could act, first the assigned one, then the standbys
    - ``basis``: all inputs of the decision; an equal basis gives an equal decision
    - ``fault``: the strategy's failure, if the fallback ``nearest`` decided instead
    - ``consensus``: the strategy's decision before the hysteresis was applied
    """

    assigned: str | None
    digest: str
    why: str
    ranking: tuple[str, ...] = ()
    basis: tuple[object, ...] = ()
    fault: str = ""
    consensus: Consensus | None = None


def decide(
    members: Iterable[Member],
    strategy: ConsensusAlgorithm,
    hysteresis: float,
    waiting_period: float,
    since_first: float | None,
    has_word: bool | None = None,
) -> Decision:
    """Decide from the reports of ``members`` with ``strategy``; a third-party strategy must be guarded.

    A strategy that reads more than these reports lists it in its ``basis``.

    ``since_first`` is the number of seconds since the first report, None without reports.  Within the waiting period
    no agent is assigned, unless all available members have reported or an agent already acts. The acting agent keeps
    the task until the cost of another agent is lower by ``hysteresis``.

    If ``members`` are only the reporters of a large team, ``has_word`` is whether the quorum members have announced
    the best agent of the whole team. Until they have, for a limited time, no agent is assigned.
    """
    present = {m.uuid: m for m in members}
    view = make_view(strategy)
    reports = {m.uuid: report for m in present.values() if (report := view.make_report(m)) is not None}
    acting = sorted((m for m in present.values() if m.status == EXECUTING and m.uuid in reports), key=_acting_sort_key)
    basis: tuple[object, ...] = (
        tuple(sorted(present)),
        tuple(sorted(reports.values(), key=lambda report: report.agent)),
        tuple((m.token, m.uuid) for m in acting),
        *getattr(strategy, "basis", ()),
    )
    if not reports or since_first is None:
        return Decision(None, "", "no agent has reported yet", basis=basis)
    missing = sorted(m.name for m in present.values() if m.uuid not in reports and m.available)
    if has_word is not None:
        if not (has_word or acting) and since_first < waiting_period + ANNOUNCEMENT_TIMEOUT_S:
            return Decision(None, "", "waiting for the quorum members", basis=basis)
    elif missing and since_first < waiting_period and not acting:
        return Decision(None, "", f"waiting for {', '.join(missing)}", basis=basis)
    holder = reports[acting[0].uuid] if acting else None
    consensus, best = _choose(list(reports.values()), holder, strategy, hysteresis)
    fault = consensus.reason if consensus.strategy not in ("", strategy.name) else ""
    if best is None:
        why_not = consensus.reason[:MAX_REASON_CHARS] or "no report counts"
        return Decision(None, consensus.digest, why_not, basis=basis, fault=fault, consensus=consensus)
    name, cost = present[best].name, reports[best].cost
    agreed = format_agreement(consensus.value, consensus.choice)
    among = consensus.reason[:MAX_REASON_CHARS] if consensus.task and not fault else f"best of {len(reports)}"
    why = f"{name}, {cost:.2f}, {among}" + (f"; agreed on {agreed}" if agreed else "")
    rest = (agent for agent in (consensus.assigned_agent, *consensus.standby) if agent is not None)
    order = tuple(dict.fromkeys((best, *rest)))
    return Decision(best, consensus.digest, f"{why}; {fault}" if fault else why, order, basis, fault, consensus)


def _choose(
    reports: Sequence[Report], holder: Report | None, strategy: ConsensusAlgorithm, hysteresis: float
) -> tuple[Consensus, str | None]:
    """Return the strategy's decision, and the agent that should act: the holder, unless another agent is better."""
    consensus = strategy.find(list(reports))
    best = next((r for r in reports if r.agent == consensus.assigned_agent), None)
    if holder is not None and (best is None or not strategy.improves(holder, best, hysteresis)):
        best = holder
    return consensus, None if best is None else best.agent


def _acting_sort_key(member: Member) -> tuple[int, float, str]:
    """Return the sort key by which the actual holder is first among several agents that report that they act.

    The agent with the newest fencing token is the holder; the other agents have not received its report yet.
    """
    return -member.token, member.cost or 0.0, member.uuid
