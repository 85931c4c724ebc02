"""Decision: the rule between reports and deeds (Algorithm 4.5, revised); pure.

The reports of all present members go in; who is assigned comes out, or why there is nobody yet.  It is taken again at
every change: a member that left or came, a report, an assigned agent that goes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from middleware.consensus.bidding.panel import PATIENCE
from middleware.consensus.strategy import Consensus, ConsensusAlgorithm, Report, agreement
from middleware.consensus.view import view_of
from middleware.directory.presence import EXECUTING
from middleware.tasks.task import Member

REASON = 100
"""Characters of a strategy's reason for naming nobody: it travels in each report."""


@dataclass(frozen=True)
class Decision:
    """Who is ``assigned`` (a uuid, or None), a ``digest`` of the reports used, and ``why`` in a person's words.

    ``order`` are all who could act, the assigned one first and then those that stand by; ``basis`` is everything that
    the decision was computed from, so that an equal basis gives an equal decision; ``fault`` says how the strategy
    failed where it did, and the nearest was taken instead; ``consensus`` is what was found before the hysteresis.
    """

    assigned: str | None
    digest: str
    why: str
    order: tuple[str, ...] = ()
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
    """The consensus point of ``members``, as ``strategy`` finds it (a foreign one from behind its guard).

    A strategy that goes by more than these reports has it in ``basis``.

    ``since_first`` is the seconds since the first report was seen, None when there is none.  Within the waiting period
    nobody is assigned, unless everybody has reported (or has no body free to do so), or somebody acts already; whoever
    acts keeps the task until another is better by the ``hysteresis``.

    Where the members are only a panel of all, ``has_word`` says whether the council has announced who is the best of
    all: until then nobody is assigned, for a while longer.
    """
    present = {m.uuid: m for m in members}
    view = view_of(strategy)
    reports = {m.uuid: report for m in present.values() if (report := view.report(m)) is not None}
    acting = sorted((m for m in present.values() if m.status == EXECUTING and m.uuid in reports), key=_precedence)
    basis: tuple[object, ...] = (
        tuple(sorted(present)),
        tuple(sorted(reports.values(), key=lambda report: report.agent)),
        tuple((m.token, m.uuid) for m in acting),
        *getattr(strategy, "basis", ()),
    )
    if not reports or since_first is None:
        return Decision(None, "", "nobody has reported yet", basis=basis)
    missing = sorted(m.name for m in present.values() if m.uuid not in reports and m.available)
    if has_word is not None:
        if not (has_word or acting) and since_first < waiting_period + PATIENCE:
            return Decision(None, "", "waiting for the council", basis=basis)
    elif missing and since_first < waiting_period and not acting:
        return Decision(None, "", f"waiting for {', '.join(missing)}", basis=basis)
    holder = reports[acting[0].uuid] if acting else None
    consensus, best = _chosen(list(reports.values()), holder, strategy, hysteresis)
    fault = consensus.reason if consensus.strategy not in ("", strategy.name) else ""
    if best is None:
        why_not = consensus.reason[:REASON] or "no report counts"
        return Decision(None, consensus.digest, why_not, basis=basis, fault=fault, consensus=consensus)
    name, cost = present[best].name, reports[best].cost
    agreed = agreement(consensus.value, consensus.choice)
    among = consensus.reason[:REASON] if consensus.task and not fault else f"best of {len(reports)}"
    why = f"{name}, {cost:.2f}, {among}" + (f"; agreed on {agreed}" if agreed else "")
    rest = (agent for agent in (consensus.assigned_agent, *consensus.standby) if agent is not None)
    order = tuple(dict.fromkeys((best, *rest)))
    return Decision(best, consensus.digest, f"{why}; {fault}" if fault else why, order, basis, fault, consensus)


def _chosen(
    reports: Sequence[Report], holder: Report | None, strategy: ConsensusAlgorithm, hysteresis: float
) -> tuple[Consensus, str | None]:
    """What the strategy finds, and who should act: whoever does already, unless another is clearly better."""
    consensus = strategy.find(list(reports))
    best = next((r for r in reports if r.agent == consensus.assigned_agent), None)
    if holder is not None and (best is None or not strategy.improves(holder, best, hysteresis)):
        best = holder
    return consensus, None if best is None else best.agent


def _precedence(member: Member) -> tuple[int, float, str]:
    """Of several that say to act the one with the newest token does, the others do not know yet."""
    return -member.token, member.cost or 0.0, member.uuid
