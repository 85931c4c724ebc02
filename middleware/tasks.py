"""Tasks: what is to be done, who can do it (Algorithm 4.4), and the record that says so.

A task is a team record under one key, written once by whoever submits it; each participant writes a slot of its own under
the task's group key, and the outcome is one more team record there.  So nothing is ever read, changed and written back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import msgpack

from middleware.entangled.kademlia.contact import Contact, unpacked
from middleware.entangled.identity import node_id
from middleware.entangled.record import Record, hashed_key
from middleware.presence import Capabilities

TASKS = hashed_key("tasks")
COMPLETED, FAILED, CANCELLED = "COMPLETED", "FAILED", "CANCELLED"
OUTCOMES = (COMPLETED, FAILED, CANCELLED)
MEMBER = "member"
RESULT = "result"


def group_key(task_id: str) -> bytes:
    """The key under which the participants of a task report."""
    return hashed_key(f"task/{task_id}")


@dataclass(frozen=True)
class Task:
    """One thing to be done, by one device (``exclusive``), decided by ``strategy``.

    ``requirements`` maps capability names to properties that a device must at least have; ``waiting_period`` is how long the
    agents wait for each other's reports after the first one, in seconds; ``lease_ttl`` how long the right to
    act outlives a silent holder; ``hysteresis`` by which share a late report must be better to take the task over;
    ``council`` are the nodes whose majority grants that right, pinned when the task is made.
    """

    task_id: str
    kind: str
    title: str
    requirements: Capabilities = field(default_factory=dict)
    parameters: Mapping[str, float | str] = field(default_factory=dict)
    strategy: str = "nearest"
    waiting_period: float = 8.0
    lease_ttl: float = 1.5
    hysteresis: float = 0.1
    created: float = 0.0
    council: tuple[Contact, ...] = ()

    def packed(self) -> bytes:
        """The value of the task's record."""
        content = {f.name: getattr(self, f.name) for f in fields(self)}
        content["council"] = [contact.packed() for contact in self.council]
        return bytes(msgpack.packb(content))


@dataclass(frozen=True)
class Member:
    """What one participant reports to the others (its slot under the group key).

    ``cost`` is the measured distance in metres, or None while it has nothing to report; ``assigned`` the uuid of the
    agent that it computed as the consensus point; ``digest`` of the reports that it computed it from.
    """

    uuid: str
    name: str
    status: str
    cost: float | None = None
    assigned: str = ""
    digest: str = ""
    token: int = 0
    why: str = ""

    def packed(self) -> bytes:
        """The value of the member's record."""
        return bytes(msgpack.packb(asdict(self)))


@dataclass(frozen=True)
class Result:
    """How a task ended: ``outcome`` is one of ``OUTCOMES``; ``bids`` are the reports that decided it, (name, metres) each."""

    outcome: str
    by: str
    took: float = 0.0
    token: int = 0
    bids: tuple[tuple[str, float], ...] = ()

    def packed(self) -> bytes:
        """The value of the result's record."""
        return bytes(msgpack.packb(asdict(self)))


def refusals(capabilities: Capabilities, requirements: Capabilities) -> list[str]:
    """Why a device with ``capabilities`` cannot do what ``requirements`` ask; empty where it can (Algorithm 4.4)."""
    reasons = []
    for name, properties in requirements.items():
        if name not in capabilities:
            reasons.append(f"has no {name}")
            continue
        for prop, needed in properties.items():
            has = capabilities[name].get(prop)
            if has is None:
                reasons.append(f"{name} does not say its {prop}")
            elif isinstance(needed, str) or isinstance(has, str):
                if has != needed:
                    reasons.append(f"{name} {prop} is {has}, not {needed}")
            elif not has >= needed:
                reasons.append(f"{name} {prop} is {has:g}, less than {needed:g}")
    return reasons


def task_of(record: Record) -> Task | None:
    """The task in a record, or None where its value is not one."""
    content = _content(record)
    if content is None:
        return None
    council = tuple(unpacked(c) for c in content.get("council", ()) if isinstance(c, list))
    if any(c is None for c in council):
        return None
    content["council"] = council
    try:
        task = Task(**{f.name: content[f.name] for f in fields(Task) if f.name in content})
        numbers = (task.waiting_period, task.lease_ttl, task.hysteresis, task.created)
        lawful = all(isinstance(t, str) for t in (task.task_id, task.kind, task.title, task.strategy)) and all(
            isinstance(n, float | int) and math.isfinite(n) and n >= 0 for n in numbers
        )
        lawful = lawful and all(isinstance(p, dict) for p in task.requirements.values())
        return task if lawful and task.lease_ttl > 0 and task.task_id == record.name else None
    except (TypeError, AttributeError):
        return None


def member_of(record: Record) -> Member | None:
    """The member report in a record, or None; a cost that is no finite distance counts as "nothing to report"."""
    content = _content(record)
    if record.name != MEMBER or content is None:
        return None
    try:
        member = Member(**{f.name: content[f.name] for f in fields(Member) if f.name in content})
    except TypeError:
        return None
    texts = (member.uuid, member.name, member.status, member.assigned, member.digest, member.why)
    if not all(isinstance(text, str) for text in texts) or type(member.token) is not int:
        return None
    if node_id(record.owner).hex() != member.uuid:
        return None  # nobody reports for another
    cost = member.cost
    sound = isinstance(cost, float | int) and math.isfinite(cost) and cost >= 0
    return member if cost is None or sound else None


def result_of(record: Record) -> Result | None:
    """The outcome in a record, or None."""
    content = _content(record)
    if record.name != RESULT or content is None or content.get("outcome") not in OUTCOMES:
        return None
    try:
        bids = tuple((str(name), float(cost)) for name, cost in content.get("bids", ()))
        return Result(
            str(content["outcome"]), str(content["by"]), float(content["took"]), int(content["token"]), bids
        )
    except (TypeError, ValueError, KeyError):
        return None


def outcome_of(records: list[Record]) -> Result | None:
    """How the task of a group ended, or None while it is open; of several results the highest token holds."""
    results = [result for record in records if (result := result_of(record)) is not None]
    return max(results, key=lambda result: (result.token, result.outcome, result.by), default=None)


def _content(record: Record) -> dict[str, Any] | None:
    if record.value is None:
        return None
    try:
        content = msgpack.unpackb(record.value, strict_map_key=True)
    except Exception:  # the decoder raises many kinds on crafted bytes
        return None
    return content if isinstance(content, dict) else None
