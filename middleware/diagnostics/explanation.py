"""Explanation: what the agents' verdicts on one task say together; pure.

Who agrees, and who differs from the others in what: the winner, the rule or its version, the reports that it knew.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from middleware.consensus.strategy import agreement
from middleware.consensus.verdict import MANY, Reported, Verdict

TOLD = 3
"""Reports in which two agents differ that are named one by one."""


@dataclass(frozen=True)
class Difference:
    """Who differs from the others, and in what."""

    name: str
    what: str


@dataclass(frozen=True)
class Ruling:
    """What one epoch came to: the agents' verdicts side by side.

    ``winner`` is the uuid named by most (the lowest where two are), ``chosen`` its name; ``agree`` names those that
    named it, ``of`` counts the participants, or those who are to tell where there are many.  ``differ`` has whoever
    named another, used another rule or knew other reports than most of those that agree; the rest is what these wrote.
    ``token`` is the winner's, 0 where it told of none; ``agreed`` is what they agreed on by number, place or vote.
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
    reports: tuple[Reported, ...]
    silent: tuple[str, ...]
    agreed: str = ""


@dataclass(frozen=True)
class Explanation:
    """Why who went: the rulings of a task, the newest epoch first."""

    task: str
    epochs: tuple[Ruling, ...] = ()


def explained(verdicts: Iterable[Verdict]) -> Explanation:
    """What ``verdicts`` of one task explain together; their order does not matter."""
    epochs: dict[int, dict[str, Verdict]] = {}
    task = ""
    for verdict in sorted(verdicts, key=lambda v: (v.epoch, v.agent, v.packed())):
        task = verdict.task
        epochs.setdefault(verdict.epoch, {})[verdict.agent] = verdict
    rulings = [_ruling(epoch, list(epochs[epoch].values())) for epoch in sorted(epochs, reverse=True)]
    return Explanation(task, tuple(rulings))


def as_text(explanation: Explanation) -> str:
    """The explanation for a person, the newest epoch first; empty where nothing was decided yet."""
    return "".join(_paragraph(ruling) for ruling in explanation.epochs)


# -- inside -------------------------------------------------------------------------------------------------------


def _ruling(epoch: int, verdicts: Sequence[Verdict]) -> Ruling:
    votes = Counter(v.winner for v in verdicts)
    winner = min(votes, key=lambda uuid: (-votes[uuid], not uuid, uuid))
    agreeing = [v for v in verdicts if v.winner == winner]
    grounds = Counter(_grounds(v) for v in agreeing)
    most = min(grounds, key=lambda ground: (-grounds[ground], ground))
    reference = next(v for v in agreeing if _grounds(v) == most)
    names = {r.agent: r.name for v in verdicts for r in v.reports} | {v.agent: v.name for v in verdicts}
    differ = [Difference(v.name, what) for v in verdicts if (what := _differences(v, reference, names))]
    spoke = {v.agent for v in verdicts}
    mute = [r.name for r in reference.reports if r.agent not in spoke]
    differ += [Difference(name, "has told no decision") for name in mute]
    return Ruling(
        epoch,
        winner,
        _name(winner, names),
        tuple(sorted(v.name for v in agreeing)),
        max(len(verdicts), reference.participants if reference.participants <= MANY else len(reference.reports)),
        tuple(sorted(differ, key=lambda each: (each.name, each.what))),
        reference.rule,
        reference.version,
        reference.hysteresis,
        tuple(_name(uuid, names) for uuid in reference.standby),
        reference.digest,
        max((v.token for v in agreeing if v.agent == winner), default=0),
        reference.reported,
        reference.reports,
        reference.silent,
        agreement(reference.value, reference.choice),
    )


def _grounds(verdict: Verdict) -> tuple[str, str, str]:
    return (verdict.rule, verdict.version, verdict.digest)


def _differences(verdict: Verdict, reference: Verdict, names: Mapping[str, str]) -> str:
    """In what a verdict differs from that of the majority; empty where it does not."""
    told = []
    if verdict.winner != reference.winner:
        told.append(f"names {_name(verdict.winner, names)}")
    if (verdict.rule, verdict.version) != (reference.rule, reference.version):
        told.append(f"decided by {_rule(verdict)}, not {_rule(reference)}")
    agreed = agreement(verdict.value, verdict.choice)
    if agreed != agreement(reference.value, reference.choice):
        told.append(f"agreed on {agreed or 'nothing'}")
    if verdict.digest != reference.digest:
        told.append(_other_reports(verdict, reference))
    return "; ".join(told)


def _other_reports(verdict: Verdict, reference: Verdict) -> str:
    are_whole = all(len(v.reports) == v.reported for v in (verdict, reference))
    knew, known = ({r.agent: r for r in v.reports} for v in (verdict, reference))
    told = []
    for agent in sorted({**knew, **known}, key=lambda agent: ({**known, **knew}[agent].name, agent)):
        if agent not in knew:
            told.append(f"no report of {known[agent].name}")
        elif agent not in known:
            told.append(f"a report of {knew[agent].name}")
        elif knew[agent].cost != known[agent].cost:
            told.append(f"{knew[agent].name} at {knew[agent].cost:.2f}, not {known[agent].cost:.2f}")
        elif knew[agent].more != known[agent].more:
            told.append(f"{knew[agent].name} with {knew[agent].more or 'nothing more'}")
    if not are_whole or not told:
        return "knew other reports"
    more = [f"{len(told) - TOLD} more"] if len(told) > TOLD else []
    return f"knew {', '.join([*told[:TOLD], *more])}"


def _paragraph(ruling: Ruling) -> str:
    """One ruling as lines."""
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


def _rule(verdict: Verdict) -> str:
    return f"{verdict.rule} {verdict.version}".rstrip()


def _name(uuid: str, names: Mapping[str, str]) -> str:
    return names.get(uuid, uuid[:8]) or "nobody"
