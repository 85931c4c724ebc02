"""Verdict: one agent's signed account of one decision; pure (what all of them say together: ``explanation``).

Each agent that takes part in a task writes whom it named, by which rule and from which reports, into slots of its own
under a key beside the task's group: who asks why reads it, and those at work are not told.  The record's signature is
the agent's; nobody can testify for another.  The accounts are team records: why somebody went can be asked after it is
gone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import zip_longest

import msgpack

from middleware.consensus.strategy import READABLE, Consensus, Report, agreement
from middleware.consensus.view import View
from middleware.directory.presence import EXECUTING
from middleware.entangled.identity import ID_BYTES, node_id
from middleware.entangled.record import Record, hashed_key
from middleware.entangled.value import is_number, is_whole, mapping_of
from middleware.tasks.task import Member, is_choice, is_value

SLOT = "verdict"
KEPT = 4
"""Epochs of one task that an agent keeps: the newest takes the slot of the one that was ``KEPT`` before it."""
MANY, BEST = 30, 8
"""Of more than ``MANY`` reports the ``BEST`` are written down, with the count of all; as many of the silent."""
STANDBY = 3
MAX_VERDICT = 3300
"""Bytes of a verdict at most: three datagrams, and one for a team of ten."""
NAME, WORDS = 40, 160
USUAL = Report("", 0.0)


@dataclass(frozen=True)
class Reported:
    """What one participant had reported when it was decided: its uuid, its name, and the cost.

    ``more`` is what else counted, in words; empty where nothing did, or was as usual.
    """

    agent: str
    name: str
    cost: float
    more: str = ""


@dataclass(frozen=True)
class Verdict:
    """Whom ``agent`` (a uuid) named as the one to do ``task`` in ``epoch``, and why.

    ``winner`` and ``standby`` are uuids, ``winner`` empty where nobody was fit.  ``rule`` and ``version`` are those of
    the strategy, ``hysteresis`` tells in words what became of whoever acted before.  ``reports`` are the best first;
    ``reported`` counts all there were, ``silent`` names participants without a report, ``participants`` counts both.
    ``digest`` is of the reports as this agent computed it; ``token`` is not 0 where it holds the right to act.
    ``value`` and ``choice`` are what was agreed on by number, place or vote, empty where nothing was.
    """

    agent: str
    name: str
    task: str
    epoch: int
    rule: str
    version: str
    winner: str
    standby: tuple[str, ...]
    hysteresis: str
    digest: str
    token: int
    participants: int
    reported: int
    reports: tuple[Reported, ...]
    silent: tuple[str, ...]
    value: tuple[float, ...] = ()
    choice: str = ""

    @property
    def key(self) -> bytes:
        """The key under which it is written."""
        return verdicts_key(self.task)

    @property
    def is_witness(self) -> bool:
        """Whether its agent is to write it: in a group of more than ``MANY``, those with the best reports do."""
        return self.participants <= MANY or self.agent in [report.agent for report in self.reports[:BEST]]

    @property
    def slot(self) -> str:
        """The name of the slot under ``key``."""
        return slot_of(self.epoch)

    def packed(self) -> bytes:
        """The value of the verdict's record, at most ``MAX_VERDICT`` bytes whatever the texts."""
        content = {
            "name": _cut(self.name, NAME),
            "task": _cut(self.task, 64),
            "epoch": self.epoch,
            "rule": _cut(self.rule, 64),
            "version": _cut(self.version, NAME),
            "winner": bytes.fromhex(self.winner),
            "standby": [bytes.fromhex(uuid) for uuid in self.standby[:STANDBY]],
            "hysteresis": _cut(self.hysteresis, WORDS),
            "digest": _cut(self.digest, 64),
            "token": self.token,
            "participants": self.participants,
            "reported": self.reported,
            "reports": [[bytes.fromhex(r.agent), _cut(r.name, NAME), r.cost] for r in self.reports[:MANY]],
            "silent": [_cut(name, NAME) for name in self.silent[:BEST]],
        }
        if self.value:
            content["value"] = list(self.value)
        if self.choice:
            content["choice"] = _cut(self.choice, 64)
        value = bytes(msgpack.packb(content))
        more = [_cut(r.more, NAME) for r in self.reports[:MANY]]
        while any(more):
            told = bytes(msgpack.packb({**content, "more": more}))
            if len(told) <= MAX_VERDICT:
                return told
            more.pop()  # of the worst ones only the cost
        return value


def verdicts_key(task: str) -> bytes:
    """The key under which the verdicts on a task lie."""
    return hashed_key(verdicts_text(task))


def verdicts_text(task: str) -> str:
    """The text of that key, as a shell names it."""
    return f"task/{task}/why"


def slot_of(epoch: int) -> str:
    """The slot of an epoch's verdict."""
    return f"{SLOT}/{epoch % KEPT}"


def verdict_from(
    task: str,
    epoch: int,
    me: Member,
    others: Iterable[Member],
    rule: str,
    version: str,
    consensus: Consensus,
    assigned: str | None,
    hysteresis: float,
    token: int = 0,
    view: View | None = None,
) -> Verdict:
    """The account of one decision that ``me`` took.

    ``consensus`` is what the strategy found among the reports, ``assigned`` who was decided for after the
    ``hysteresis`` (a share), ``token`` that of the lease which this agent holds, or 0; ``view`` is what the strategy
    goes by.
    """
    view = view or View()
    members = {m.uuid: m for m in (*others, me)}
    fit = [m for m in members.values() if m.cost is not None]
    told = (Reported(m.uuid, m.name, float(m.cost or 0.0), _more(view.report(m))) for m in fit)
    reports = sorted(told, key=lambda r: (r.cost, r.agent))
    best = reports if len(reports) <= MANY else reports[:BEST]
    silent = sorted(m.name for m in members.values() if m.cost is None)
    acting = sorted((m for m in fit if m.status == EXECUTING), key=lambda m: (m.cost, m.uuid))
    return Verdict(
        me.uuid,
        me.name,
        task,
        epoch,
        rule,
        version,
        assigned or "",
        tuple(uuid for uuid in (*_first(consensus.assigned_agent), *consensus.standby) if uuid != assigned)[:STANDBY],
        _outcome(members, acting[0] if acting else None, consensus, assigned, hysteresis),
        consensus.digest,
        token,
        len(members),
        len(reports),
        tuple(best),
        tuple(silent[:BEST]),
        consensus.value if is_value(consensus.value) else (),
        consensus.choice if is_choice(consensus.choice) else "",
    )


def verdict_of(record: Record) -> Verdict | None:
    """The verdict in a record, or None where it holds none, or one in another's name; never raises."""
    content = mapping_of(record, MAX_VERDICT)
    if content is None or not record.name.startswith(f"{SLOT}/"):
        return None
    texts = [content.get(name) for name in ("name", "task", "rule", "version", "hysteresis", "digest")]
    wholes = [content.get(name) for name in ("epoch", "token", "participants", "reported")]
    winner, standby = content.get("winner"), _uuids(content.get("standby"))
    reports, silent = _reports(content.get("reports"), content.get("more", [])), content.get("silent")
    value, choice = content.get("value", []), content.get("choice", "")
    if not all(_is_line(text) for text in texts) or not all(is_whole(number) for number in wholes):
        return None
    if not isinstance(winner, bytes) or len(winner) not in (0, ID_BYTES) or standby is None or reports is None:
        return None
    if not isinstance(silent, list) or not all(_is_line(name) for name in silent):
        return None
    if not isinstance(value, list) or not is_value(tuple(value)) or not is_choice(choice):
        return None
    name, task, rule, version, hysteresis, digest = (str(text) for text in texts)
    epoch, token, participants, reported = (int(number or 0) for number in wholes)
    if record.name != slot_of(epoch) or reported < len(reports) or participants < reported:
        return None
    agent = node_id(record.owner).hex()
    return Verdict(
        agent,
        name,
        task,
        epoch,
        rule,
        version,
        winner.hex(),
        standby,
        hysteresis,
        digest,
        token,
        participants,
        reported,
        reports,
        tuple(silent),
        tuple(map(float, value)),
        choice,
    )


# -- inside -------------------------------------------------------------------------------------------------------


def _outcome(
    members: Mapping[str, Member], acting: Member | None, found: Consensus, assigned: str | None, hysteresis: float
) -> str:
    """What became of whoever acted, in words; where nobody is to act, why not."""
    best = found.assigned_agent
    if not assigned:
        return found.reason or "no report counts"
    if acting is None:
        return f"nobody acted before; {found.reason}" if found.task else "nobody acted before"
    name = members[best].name if best is not None and best in members else "nobody"
    if assigned == acting.uuid:
        if best == assigned:
            return f"{acting.name} acts already, and nobody is better"
        return f"{name} is the best, but not better by {hysteresis:.0%} than {acting.name}, who acts"
    return f"{name} is better by more than {hysteresis:.0%} than {acting.name}, who acted"


def _first(uuid: str | None) -> tuple[str, ...]:
    return () if uuid is None else (uuid,)


def _cut(text: str, most: int) -> str:
    """At most ``most`` bytes of a text, without what no terminal should be shown: other members chose their names."""
    printable = "".join(c if c.isprintable() else "?" for c in text)
    return printable.encode(errors="replace")[:most].decode(errors="ignore")


def _is_line(value: object) -> bool:
    """Whether ``value`` is text that a terminal can be shown."""
    return isinstance(value, str) and value.isprintable()


def _uuids(value: object) -> tuple[str, ...] | None:
    if not isinstance(value, list) or len(value) > STANDBY:
        return None
    lawful = all(isinstance(uuid, bytes) and len(uuid) == ID_BYTES for uuid in value)
    return tuple(uuid.hex() for uuid in value) if lawful else None


def _more(report: Report | None) -> str:
    """What of a report counted beside the cost, in words; what is as usual is left out."""
    if report is None:
        return ""
    said = {name: getattr(report, name) for name in READABLE if getattr(report, name) != getattr(USUAL, name)}
    return ", ".join(_said(name, value) for name, value in said.items())


def _said(name: str, value: object) -> str:
    if name == "battery":
        return f"battery {value:.0%}"
    if name == "load":
        return f"{value:g} other task{'' if value == 1 else 's'}"
    if name == "choice":
        return f"for {agreement((), str(value))}"
    if isinstance(value, tuple):
        return f"at {agreement(value, '')}"
    return f"{name} {value:g}"


def _reports(value: object, more: object) -> tuple[Reported, ...] | None:
    if not isinstance(value, list) or len(value) > MANY:
        return None
    if not isinstance(more, list) or len(more) > len(value) or not all(_is_line(each) for each in more):
        return None
    reports = []
    for entry, said in zip_longest(value, more, fillvalue=""):
        if not isinstance(entry, list) or len(entry) != 3:
            return None
        agent, name, cost = entry
        is_lawful = isinstance(agent, bytes) and len(agent) == ID_BYTES and _is_line(name)
        if not is_lawful or not is_number(cost) or cost < 0:
            return None
        reports.append(Reported(agent.hex(), name, float(cost), said))
    return tuple(reports)
