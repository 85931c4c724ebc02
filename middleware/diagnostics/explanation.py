"""Comparison of the agents' decision records for one task.  Pure.

The result lists the agents that agree.  For each agent that does not agree, it lists the difference: a different
winner, a different strategy or different reports.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from middleware.consensus.decision_record import MAX_REPORTS, DecisionRecord, RecordedReport
from middleware.consensus.strategy import format_agreement

MAX_DIFFERENCES = 3
"""Maximum number of differing reports that are listed individually."""


@dataclass(frozen=True)
class Difference:
    """The difference between the decision of one agent and the decision of the majority."""

    name: str
    what: str


@dataclass(frozen=True)
class EpochExplanation:
    """The result of one epoch: the agents' decision records compared.

    ``winner`` is the uuid of the agent that most agents chose (the lowest uuid if there is a tie), and ``chosen`` is
    its name.  ``agree`` are the names of the agents that chose this winner.  ``of`` is the number of agents that have
    to publish their decision: all participants, or in a large group some of them.  ``differ`` lists the agents whose
    winner, strategy or reports differ from the values of most agents in ``agree``.  ``token`` is the winner's fencing
    token, 0 if unknown, and ``agreed`` is the number, place or option that the strategy agreed on.  The other fields
    are from the records of the majority.
    """

    epoch: int
    winner: str
    chosen: str
    agree: tuple[str, ...]
    of: int
    differ: tuple[Difference, ...]
    rule: str
    version: str
    hysteresis: str
    standby: tuple[str, ...]
    digest: str
    token: int
    reported: int
    reports: tuple[RecordedReport, ...]
    silent: tuple[str, ...]
    agreed: str = ""


@dataclass(frozen=True)
class Explanation:
    """The explanation of a task's assignments: the result of each epoch, the newest first."""

    task: str
    epochs: tuple[EpochExplanation, ...] = ()


def explain_decisions(records: Iterable[DecisionRecord]) -> Explanation:
    """Compare the decision records of one task, in any order."""
    epochs: dict[int, dict[str, DecisionRecord]] = {}
    task = ""
    for record in sorted(records, key=lambda v: (v.epoch, v.agent, v.pack())):
        task = record.task
        epochs.setdefault(record.epoch, {})[record.agent] = record
    rulings = [_explain_epoch(epoch, list(epochs[epoch].values())) for epoch in sorted(epochs, reverse=True)]
    return Explanation(task, tuple(rulings))


def format_explanation(explanation: Explanation) -> str:
    """Return the explanation as text, the newest epoch first; empty if there is no decision yet."""
    return "".join(_format_epoch(ruling) for ruling in explanation.epochs)


# -- implementation -----------------------------------------------------------------------------------------------


def _explain_epoch(epoch: int, records: Sequence[DecisionRecord]) -> EpochExplanation:
    votes = Counter(v.winner for v in records)
    winner = min(votes, key=lambda uuid: (-votes[uuid], not uuid, uuid))
    agreeing = [v for v in records if v.winner == winner]
    grounds = Counter(_get_basis(v) for v in agreeing)
    most = min(grounds, key=lambda reason: (-grounds[reason], reason))
    reference = next(v for v in agreeing if _get_basis(v) == most)
    names = {r.agent: r.name for v in records for r in v.reports} | {v.agent: v.name for v in records}
    differ = [Difference(v.name, what) for v in records if (what := _describe_differences(v, reference, names))]
    deciders = {v.agent for v in records}
    missing = [r.name for r in reference.reports if r.agent not in deciders]
    differ += [Difference(name, "has no decision record") for name in missing]
    return EpochExplanation(
        epoch,
        winner,
        _find_name(winner, names),
        tuple(sorted(v.name for v in agreeing)),
        max(len(records), reference.participants if reference.participants <= MAX_REPORTS else len(reference.reports)),
        tuple(sorted(differ, key=lambda each: (each.name, each.what))),
        reference.rule,
        reference.version,
        reference.hysteresis,
        tuple(_find_name(uuid, names) for uuid in reference.standby),
        reference.digest,
        max((v.token for v in agreeing if v.agent == winner), default=0),
        reference.reported,
        reference.reports,
        reference.silent,
        format_agreement(reference.value, reference.choice),
    )


def _get_basis(record: DecisionRecord) -> tuple[str, str, str]:
    return (record.rule, record.version, record.digest)


def _describe_differences(record: DecisionRecord, reference: DecisionRecord, names: Mapping[str, str]) -> str:
    """Return the differences between a decision record and the record of the majority; empty if there are none."""
    differences = []
    if record.winner != reference.winner:
        differences.append(f"names {_find_name(record.winner, names)}")
    if (record.rule, record.version) != (reference.rule, reference.version):
        differences.append(f"decided by {_format_rule(record)}, not {_format_rule(reference)}")
    agreed = format_agreement(record.value, record.choice)
    if agreed != format_agreement(reference.value, reference.choice):
        differences.append(f"agreed on {agreed or 'nothing'}")
    if record.digest != reference.digest:
        differences.append(_describe_other_reports(record, reference))
    return "; ".join(differences)


def _describe_other_reports(record: DecisionRecord, reference: DecisionRecord) -> str:
    are_whole = all(len(v.reports) == v.reported for v in (record, reference))
    own, other = ({r.agent: r for r in v.reports} for v in (record, reference))
    differences = []
    for agent in sorted({**own, **other}, key=lambda agent: ({**other, **own}[agent].name, agent)):
        if agent not in own:
            differences.append(f"no report of {other[agent].name}")
        elif agent not in other:
            differences.append(f"a report of {own[agent].name}")
        elif own[agent].cost != other[agent].cost:
            differences.append(f"{own[agent].name} at {own[agent].cost:.2f}, not {other[agent].cost:.2f}")
        elif own[agent].more != other[agent].more:
            differences.append(f"{own[agent].name} with {own[agent].more or 'nothing more'}")
    if not are_whole or not differences:
        return "knew other reports"
    more = [f"{len(differences) - MAX_DIFFERENCES} more"] if len(differences) > MAX_DIFFERENCES else []
    return f"knew {', '.join([*differences[:MAX_DIFFERENCES], *more])}"


def _format_epoch(ruling: EpochExplanation) -> str:
    """Return the result of one epoch as lines of text."""
    token = f", token {ruling.token}" if ruling.token else ""
    lines = [f"epoch {ruling.epoch}: {ruling.chosen}, {len(ruling.agree)} of {ruling.of} agree{token}"]
    lines.append(
        f"  by {ruling.rule} {ruling.version}".rstrip() + f" from reports {ruling.digest}: {ruling.hysteresis}"
    )
    if ruling.agreed:
        lines.append(f"  agreed on {ruling.agreed}")
    width = max((len(name) for name in (*(r.name for r in ruling.reports), *ruling.silent)), default=0)
    for report in ruling.reports:
        line = f"  {report.name:{width}}  {report.cost:8.2f}{'  *' if report.agent == ruling.winner else ''}"
        lines.append(f"{line}  {report.more}" if report.more else line)
    if ruling.reported > len(ruling.reports):
        lines.append(f"  the best {len(ruling.reports)} of {ruling.reported} reports")
    lines += [f"  {name:{width}}  no report" for name in ruling.silent]
    if ruling.standby:
        lines.append(f"  stand by: {', '.join(ruling.standby)}")
    lines += [f"  {each.name} differs: {each.what}" for each in ruling.differ]
    return "".join(f"{line}\n" for line in lines)


def _format_rule(record: DecisionRecord) -> str:
    return f"{record.rule} {record.version}".rstrip()


def _find_name(uuid: str, names: Mapping[str, str]) -> str:
    return names.get(uuid, uuid[:8]) or "nobody"
