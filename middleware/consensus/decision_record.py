"""An agent's signed record of one decision; pure.

Each participant of a task writes its decision, the strategy and the reports into its own slots, under a key that
belongs to the task.  These records are read only to explain a decision (``middleware.diagnostics.explanation``); agents
are not notified of them.  The record is signed by its agent, so no agent can write the decision of another agent.  It
is a team record, so it remains after its agent has left.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import zip_longest

import msgpack

from middleware.consensus.report_view import ReportView
from middleware.consensus.strategy import READABLE, Consensus, Report, format_agreement
from middleware.directory.presence import EXECUTING
from middleware.entangled.identity import ID_BYTES, derive_node_id
from middleware.entangled.record import Record, hash_key
from middleware.entangled.value import is_natural, is_number, parse_mapping
from middleware.tasks.task import Member, is_choice, is_value

SLOT = "verdict"
MAX_EPOCHS = 4
"""Number of epochs of a task whose records an agent keeps; the record of a further epoch replaces the oldest."""
MAX_REPORTS, MAX_BEST_REPORTS = 30, 8
"""If there are more than ``MAX_REPORTS`` reports, only the best ``MAX_BEST_REPORTS`` and the total number are recorded.
At most ``MAX_BEST_REPORTS`` names of silent participants are recorded."""
MAX_STANDBYS = 3
MAX_RECORD_BYTES = 3300
"""Maximum size of a record's value in bytes: three datagrams; the record of a team of ten fits into one datagram."""
MAX_NAME_BYTES, MAX_TEXT_BYTES = 40, 160
DEFAULT_REPORT = Report("", 0.0)


@dataclass(frozen=True)
class RecordedReport:
    """The report of one participant at the time of the decision, with its uuid, name and cost.

    ``more`` describes the other fields that the strategy read; "" if it read no others, or all had their default
    values.
    """

    agent: str
    name: str
    cost: float
    more: str = ""


@dataclass(frozen=True)
class DecisionRecord:
    """The decision of ``agent`` (a uuid) about ``task`` in ``epoch``, with its reasons.

    - ``winner``, ``standby``: uuids; ``winner`` is empty if no agent was assigned
    - ``rule``, ``version``: name and version of the strategy
    - ``hysteresis``: a text about the effect of the hysteresis on the agent that acted before
    - ``digest``: the digest of the reports, as this agent computed it
    - ``token``: the fencing token of the lease if this agent holds it, otherwise 0
    - ``participants``, ``reported``: the number of all participants, and of those with a report
    - ``reports``: the reports, the best first
    - ``silent``: names of participants without a report
    - ``value``, ``choice``: the agreed number or place, or the option that won the vote; empty if there was no such
      result
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
    reports: tuple[RecordedReport, ...]
    silent: tuple[str, ...]
    value: tuple[float, ...] = ()
    choice: str = ""

    @property
    def key(self) -> bytes:
        """The key of the record."""
        return decision_records_key(self.task)

    @property
    def is_publisher(self) -> bool:
        """Whether this agent should publish its decision record.

        In a group of more than ``MAX_REPORTS`` members only the agents with the best reports publish records.
        """
        return self.participants <= MAX_REPORTS or self.agent in [
            report.agent for report in self.reports[:MAX_BEST_REPORTS]
        ]

    @property
    def slot(self) -> str:
        """The name of the slot under ``key``."""
        return make_slot_name(self.epoch)

    def pack(self) -> bytes:
        """Return the value of the record, at most ``MAX_RECORD_BYTES`` bytes; long strings are truncated."""
        content = {
            "name": _truncate(self.name, MAX_NAME_BYTES),
            "task": _truncate(self.task, 64),
            "epoch": self.epoch,
            "rule": _truncate(self.rule, 64),
            "version": _truncate(self.version, MAX_NAME_BYTES),
            "winner": bytes.fromhex(self.winner),
            "standby": [bytes.fromhex(uuid) for uuid in self.standby[:MAX_STANDBYS]],
            "hysteresis": _truncate(self.hysteresis, MAX_TEXT_BYTES),
            "digest": _truncate(self.digest, 64),
            "token": self.token,
            "participants": self.participants,
            "reported": self.reported,
            "reports": [
                [bytes.fromhex(r.agent), _truncate(r.name, MAX_NAME_BYTES), r.cost] for r in self.reports[:MAX_REPORTS]
            ],
            "silent": [_truncate(name, MAX_NAME_BYTES) for name in self.silent[:MAX_BEST_REPORTS]],
        }
        if self.value:
            content["value"] = list(self.value)
        if self.choice:
            content["choice"] = _truncate(self.choice, 64)
        value = bytes(msgpack.packb(content))
        more = [_truncate(r.more, MAX_NAME_BYTES) for r in self.reports[:MAX_REPORTS]]
        while any(more):
            extended = bytes(msgpack.packb({**content, "more": more}))
            if len(extended) <= MAX_RECORD_BYTES:
                return extended
            more.pop()  # if the record is too long, the worst reports are recorded only with their cost
        return value


def decision_records_key(task: str) -> bytes:
    """Return the key of the decision records of a task."""
    return hash_key(decision_records_key_text(task))


def decision_records_key_text(task: str) -> str:
    """Return the string from which that key is derived, as used in the shell."""
    return f"task/{task}/why"


def make_slot_name(epoch: int) -> str:
    """Return the name of the slot of an epoch's decision record."""
    return f"{SLOT}/{epoch % MAX_EPOCHS}"


def make_decision_record(
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
    view: ReportView | None = None,
) -> DecisionRecord:
    """Build the record of a decision of the agent ``me``.

    ``consensus`` is the decision of the strategy.  ``assigned`` is the agent that was assigned after ``hysteresis`` (a
    share of the cost) was applied.  ``token`` is the fencing token of the lease that this agent holds, or 0, and
    ``view`` is the part of a report that the strategy reads.
    """
    view = view or ReportView()
    members = {m.uuid: m for m in (*others, me)}
    able = [m for m in members.values() if m.cost is not None]
    reported = (
        RecordedReport(m.uuid, m.name, float(m.cost or 0.0), _describe_fields(view.make_report(m))) for m in able
    )
    reports = sorted(reported, key=lambda r: (r.cost, r.agent))
    best = reports if len(reports) <= MAX_REPORTS else reports[:MAX_BEST_REPORTS]
    silent = sorted(m.name for m in members.values() if m.cost is None)
    acting = sorted((m for m in able if m.status == EXECUTING), key=lambda m: (m.cost, m.uuid))
    return DecisionRecord(
        me.uuid,
        me.name,
        task,
        epoch,
        rule,
        version,
        assigned or "",
        tuple(uuid for uuid in (*_as_tuple(consensus.assigned_agent), *consensus.standby) if uuid != assigned)[
            :MAX_STANDBYS
        ],
        _describe_outcome(members, acting[0] if acting else None, consensus, assigned, hysteresis),
        consensus.digest,
        token,
        len(members),
        len(reports),
        tuple(best),
        tuple(silent[:MAX_BEST_REPORTS]),
        consensus.value if is_value(consensus.value) else (),
        consensus.choice if is_choice(consensus.choice) else "",
    )


def parse_decision_record(record: Record) -> DecisionRecord | None:
    """Return the decision in a record, or None if the record is invalid; never raises."""
    content = parse_mapping(record, MAX_RECORD_BYTES)
    if content is None or not record.name.startswith(f"{SLOT}/"):
        return None
    texts = [content.get(name) for name in ("name", "task", "rule", "version", "hysteresis", "digest")]
    wholes = [content.get(name) for name in ("epoch", "token", "participants", "reported")]
    winner, standby = content.get("winner"), _parse_uuids(content.get("standby"))
    reports, silent = _parse_reports(content.get("reports"), content.get("more", [])), content.get("silent")
    value, choice = content.get("value", []), content.get("choice", "")
    if not all(_is_line(text) for text in texts) or not all(is_natural(number) for number in wholes):
        return None
    if not isinstance(winner, bytes) or len(winner) not in (0, ID_BYTES) or standby is None or reports is None:
        return None
    if not isinstance(silent, list) or not all(_is_line(name) for name in silent):
        return None
    if not isinstance(value, list) or not is_value(tuple(value)) or not is_choice(choice):
        return None
    name, task, rule, version, hysteresis, digest = (str(text) for text in texts)
    epoch, token, participants, reported = (int(number or 0) for number in wholes)
    if record.name != make_slot_name(epoch) or reported < len(reports) or participants < reported:
        return None
    agent = derive_node_id(record.owner).hex()
    return DecisionRecord(
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


def _describe_outcome(
    members: Mapping[str, Member], acting: Member | None, found: Consensus, assigned: str | None, hysteresis: float
) -> str:
    """Describe the effect of the hysteresis on the agent that acted before, or why no agent is assigned."""
    best = found.assigned_agent
    if not assigned:
        return found.reason or "no report is valid"
    if acting is None:
        return f"no agent acted before; {found.reason}" if found.task else "no agent acted before"
    name = members[best].name if best is not None and best in members else "no agent"
    if assigned == acting.uuid:
        if best == assigned:
            return f"{acting.name} already acts, and no agent is better"
        return f"{name} is the best, but not more than {hysteresis:.0%} better than {acting.name}, which acts"
    return f"{name} is more than {hysteresis:.0%} better than {acting.name}, which acted before"


def _as_tuple(uuid: str | None) -> tuple[str, ...]:
    return () if uuid is None else (uuid,)


def _truncate(text: str, most: int) -> str:
    """Truncate a string from another member to ``most`` bytes, and replace its unprintable characters."""
    printable = "".join(c if c.isprintable() else "?" for c in text)
    return printable.encode(errors="replace")[:most].decode(errors="ignore")


def _is_line(value: object) -> bool:
    """Return whether ``value`` is printable text."""
    return isinstance(value, str) and value.isprintable()


def _parse_uuids(value: object) -> tuple[str, ...] | None:
    if not isinstance(value, list) or len(value) > MAX_STANDBYS:
        return None
    are_valid = all(isinstance(uuid, bytes) and len(uuid) == ID_BYTES for uuid in value)
    return tuple(uuid.hex() for uuid in value) if are_valid else None


def _describe_fields(report: Report | None) -> str:
    """Describe the fields besides the cost that the strategy read and that differ from their default."""
    if report is None:
        return ""
    description = {
        name: getattr(report, name) for name in READABLE if getattr(report, name) != getattr(DEFAULT_REPORT, name)
    }
    return ", ".join(_describe_field(name, value) for name, value in description.items())


def _describe_field(name: str, value: object) -> str:
    if name == "battery":
        return f"battery {value:.0%}"
    if name == "load":
        return f"{value:g} other task{'' if value == 1 else 's'}"
    if name == "choice":
        return f"for {format_agreement((), str(value))}"
    if isinstance(value, tuple):
        return f"at {format_agreement(value, '')}"
    return f"{name} {value:g}"


def _parse_reports(value: object, more: object) -> tuple[RecordedReport, ...] | None:
    if not isinstance(value, list) or len(value) > MAX_REPORTS:
        return None
    if not isinstance(more, list) or len(more) > len(value) or not all(_is_line(each) for each in more):
        return None
    reports = []
    for entry, description in zip_longest(value, more, fillvalue=""):
        if not isinstance(entry, list) or len(entry) != 3:
            return None
        agent, name, cost = entry
        is_valid = isinstance(agent, bytes) and len(agent) == ID_BYTES and _is_line(name)
        if not is_valid or not is_number(cost) or cost < 0:
            return None
        reports.append(RecordedReport(agent.hex(), name, float(cost), description))
    return tuple(reports)
