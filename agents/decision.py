"""Decision: the rule between reports and deeds (Algorithm 4.5, revised); pure.

The reports of all present members go in; who is assigned comes out, or why there is nobody yet.  It is taken again at
every change: a member that left or came, a report, an assigned agent that goes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from middleware.consensus.nearest import Nearest
from middleware.consensus.strategy import Consensus, ConsensusAlgorithm, Report
from middleware.presence import EXECUTING
from middleware.tasks import Member, is_bid


@dataclass(frozen=True)
class Decision:
    """Who is ``assigned`` (a uuid, or None), a ``digest`` of the reports used, and ``why`` in a person's words.

    ``order`` are all who could act, the assigned one first and then those that stand by; ``basis`` is everything that
    the decision was computed from, so that an equal basis gives an equal decision; ``fault`` says how the strategy
    failed where it did, and the nearest was taken instead.
    """

    assigned: str | None
    digest: str
    why: str
    order: tuple[str, ...] = ()
    basis: tuple[object, ...] = ()
    fault: str = ""


def decide(
    members: Iterable[Member],
    strategy: ConsensusAlgorithm,
    hysteresis: float,
    waiting_period: float,
    since_first: float | None,
) -> Decision:
    """The consensus point of ``members``.

    ``since_first`` is the seconds since the first report was seen, None when there is none.  Within the waiting period
    nobody is assigned, unless everybody has reported (or has no body free to do so), or somebody acts already; whoever
    acts keeps the task until another is better by the ``hysteresis``.
    """
    present = {m.uuid: m for m in members}
    reports = {m.uuid: Report(m.uuid, m.cost) for m in present.values() if m.cost is not None and is_bid(m.cost)}
    acting = sorted((m for m in present.values() if m.status == EXECUTING and m.uuid in reports), key=_precedence)
    basis: tuple[object, ...] = (
        tuple(sorted(present)),
        tuple(sorted((r.agent, r.cost) for r in reports.values())),
        tuple((m.token, m.uuid) for m in acting),
    )
    if not reports or since_first is None:
        return Decision(None, "", "nobody has reported yet", basis=basis)
    missing = sorted(m.name for m in present.values() if m.uuid not in reports and m.available)
    if missing and since_first < waiting_period and not acting:
        return Decision(None, "", f"waiting for {', '.join(missing)}", basis=basis)
    holder = reports[acting[0].uuid] if acting else None
    consensus, best, fault = _chosen(list(reports.values()), holder, strategy, hysteresis)
    if best is None:
        return Decision(None, consensus.digest, "no report counts", basis=basis, fault=fault)
    name, cost = present[best].name, reports[best].cost
    why = f"{name}, {cost:.2f}, best of {len(reports)}"
    rest = (agent for agent in (consensus.assigned_agent, *consensus.standby) if agent is not None)
    order = tuple(dict.fromkeys((best, *rest)))
    return Decision(best, consensus.digest, f"{why}; {fault}" if fault else why, order, basis, fault)


def _chosen(
    reports: Sequence[Report], holder: Report | None, strategy: ConsensusAlgorithm, hysteresis: float
) -> tuple[Consensus, str | None, str]:
    """What the strategy finds, and who should act; where it fails the nearest should, and the fault is told."""
    try:
        return *_asked(reports, holder, strategy, hysteresis), ""
    except Exception as error:  # a strategy is somebody else's
        fault = f"strategy {strategy.name} failed ({error or type(error).__name__}), nearest decides"
        return *_asked(reports, holder, Nearest(), hysteresis), fault[:120]


def _asked(
    reports: Sequence[Report], holder: Report | None, strategy: ConsensusAlgorithm, hysteresis: float
) -> tuple[Consensus, str | None]:
    consensus = strategy.find(list(reports))
    best = next((r for r in reports if r.agent == consensus.assigned_agent), None)
    if best is None and consensus.assigned_agent is not None:
        raise LookupError(f"it names {consensus.assigned_agent}, who reported nothing")
    if holder is not None and (best is None or not strategy.improves(holder, best, hysteresis)):
        best = holder
    return consensus, None if best is None else best.agent


def _precedence(member: Member) -> tuple[int, float, str]:
    """Of several that say to act the one with the newest token does, the others do not know yet."""
    return -member.token, member.cost or 0.0, member.uuid
