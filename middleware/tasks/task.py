"""Tasks, their requirements (Algorithm 4.4), and their records.

A task is a team record under one key, written once by the node that submits it.  Each participant writes its own slot
under the task's group key, and the outcome is a further team record under this key, so no record is ever changed by two
nodes.  Two kinds of records can be written by nodes that may not order tasks; these contain a proof.  A record of new
quorum members (``COUNCIL``) contains the signatures of the previous members, and a record of the end of a task
(``DONE``) the signatures of the members that granted the lease.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import lru_cache
from typing import Any

import msgpack

from middleware.consensus.lease.charter import Charter, parse_charter, parse_end_proof
from middleware.consensus.lease.lease_codec import MAX_PROOF_BYTES
from middleware.directory.presence import Capabilities
from middleware.entangled.contact import Contact, parse_contact
from middleware.entangled.identity import derive_node_id
from middleware.entangled.record import Record, hash_key
from middleware.entangled.value import (
    MAX_VALUE_BYTES,
    are_capabilities,
    are_properties,
    check_size,
    is_natural,
    is_number,
    parse_mapping,
)

TASKS = hash_key("tasks")
COMPLETED, FAILED, CANCELLED = "COMPLETED", "FAILED", "CANCELLED"
OUTCOMES = (COMPLETED, FAILED, CANCELLED)
MAX_LEASE_TTL_S = 60.0
MAX_TOLERATED = 3
MEMBER = "member"
RESULT = "result"
ORDER = "order"
COUNCIL, DONE = "council", "done"
MAX_DONE_BYTES = 2 * MAX_PROOF_BYTES
MAX_PRIORITY = 1000
MAX_CHOICE_CHARACTERS = 64
MAX_COORDINATES = 8
MAX_WEIGHT = 1e9
"""Upper bound of weights, and of the numbers and coordinates of a value."""


def group_key(task_id: str) -> bytes:
    """Return the key under which the participants of a task write their reports."""
    return hash_key(f"task/{task_id}")


@dataclass(frozen=True)
class Task:
    """A task; ``strategy`` chooses its agent.

    - ``requirements``: the capabilities that a device must have, by name, with the minimum values of their properties
    - ``waiting_period``: seconds after the first report for which agents wait for more reports
    - ``lease_ttl``: seconds after which the lease of a silent holder expires
    - ``hysteresis``: the share by which a report must be better than the acting agent's report to take over the task
    - ``council``: the quorum members that grant the lease, fixed when the task is published; if the team is large
      enough, ``tolerates`` of them may fail at the same time
    - ``configuration``: the number of the configuration, which increases with each change of the quorum members
    - ``charter``: the proof of the quorum members and of ``configuration`` (``middleware.consensus.lease.charter``)
    - ``priority``: a robot serves the task with the highest priority first; of equal priorities, the oldest task
    - ``preemptible``: a task of higher priority interrupts this task, which is resumed afterwards
    - ``deadline``: seconds after the task's creation (0: none)
    - ``stall_limit``: seconds without progress after which the lease is released (0: none)
    - ``stop_time``: seconds that the robot needs to stop
    - ``value``: the value of the task, which strategies can compare with the values of other tasks
    - ``generation``: a number that increases when an operator creates the task again
    - ``group``: tasks of one group are assigned together
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
    tolerates: int = 1
    priority: int = 0
    deadline: float = 0.0
    stop_time: float = 0.0
    value: float = 1.0
    generation: int = 0
    group: str = ""
    preemptible: bool = False
    exclusive: bool = True
    configuration: int = 1
    stall_limit: float = 0.0
    charter: bytes = b""

    def with_council(self, charter: Charter) -> Task:
        """Return this task with the quorum members of ``charter``."""
        return replace(self, council=charter.members, configuration=charter.configuration, charter=charter.packed)

    def with_newer_council(self, other: Task) -> Task:
        """Return this task with the quorum members of ``other`` if those are newer than its own."""
        own, newer = parse_charter(self.charter), parse_charter(other.charter)
        is_newer = (
            own is not None
            and newer is not None
            and own.first_council_id == newer.first_council_id
            and len(own.changes) < len(newer.changes)
        )
        return self.with_council(newer) if is_newer and newer is not None else self

    def pack(self) -> bytes:
        """Return the value of the task's record; fields with default values, or in the charter, are omitted."""
        content = _non_default_fields(self)
        if self.charter:
            content.pop("council", None)
            content.pop("configuration", None)
        elif self.council:
            content["council"] = [contact.pack() for contact in self.council]
        return check_size(bytes(msgpack.packb(content)))


@dataclass(frozen=True)
class Member:
    """One participant's report to the others, in its slot under the group key.

    - ``cost``: the measured distance in metres, or None if nothing was measured
    - ``assigned``: the uuid of the agent that the participant's decision assigned; ``digest``: the digest of the
      reports used
    - ``epoch``: the round of the task to which the report and the decision belong; ``serial``: the number of the report
      in that round.  Reports older than the newest known report are ignored.
    - ``valid_for``: seconds for which the report is valid (0: as long as its writer is present); ``age``: the seconds
      that had already passed when the record was written
    - ``available``: whether the robot is free for this task; ``load``: the participant's number of tasks
    - ``state``: the agent's state (``agents.state``); ``progress``: the share of the task that is done, 0 to 1
    - ``angle``: the robot's direction as seen from the target; ``post``: the direction to which the robot moves; both
      in radians by the compass

    Fields that only some strategies read: ``battery`` is the remaining charge, 0 to 1.  ``value`` is a number to agree
    on, or coordinates in metres; ``choice`` is a vote; ``weight`` is the weight of ``value`` and ``choice``.
    ``electorate`` is the total weight of all agents that may vote.
    """

    uuid: str
    name: str
    status: str
    cost: float | None = None
    assigned: str = ""
    digest: str = ""
    token: int = 0
    why: str = ""
    epoch: int = 0
    serial: int = 0
    state: str = ""
    available: bool = True
    load: int = 0
    age: float = 0.0
    valid_for: float = 0.0
    progress: float | None = None
    angle: float | None = None
    post: float | None = None
    battery: float = 1.0
    value: tuple[float, ...] = ()
    choice: str = ""
    weight: float = 1.0
    electorate: float = 0.0

    def pack(self) -> bytes:
        """Return the value of the member's record, without default values."""
        return check_size(bytes(msgpack.packb(_non_default_fields(self))))


@dataclass(frozen=True)
class Result:
    """The outcome of a task, one of ``OUTCOMES``, and ``why``, a reason for display.

    ``bids`` are the reports that the decision used, each (name, metres).
    """

    outcome: str
    by: str
    took: float = 0.0
    token: int = 0
    bids: tuple[tuple[str, float], ...] = ()
    why: str = ""

    def pack(self) -> bytes:
        """Return the value of the result's record."""
        return check_size(bytes(msgpack.packb(vars(self))))

    @property
    def rank(self) -> tuple[int, str, str]:
        """The sort key: if a task has several results, every node uses the result with the highest key."""
        return self.token, self.outcome, self.by


def find_unmet_requirements(capabilities: Capabilities, requirements: Capabilities) -> list[str]:
    """Return each requirement that ``capabilities`` do not meet, as text (Algorithm 4.4)."""
    reasons = []
    for name, properties in requirements.items():
        if name not in capabilities:
            reasons.append(f"has no {name}")
            continue
        for prop, needed in properties.items():
            has = capabilities[name].get(prop)
            if has is None:
                reasons.append(f"{name} has no property {prop}")
            elif isinstance(needed, str) or isinstance(has, str):
                if has != needed:
                    reasons.append(f"{name} {prop} is {has}, not {needed}")
            elif not has >= needed:
                reasons.append(f"{name} {prop} is {has:g}, less than {needed:g}")
    return reasons


def parse_task(record: Record) -> Task | None:
    """Decode the task in a record; None if it is invalid."""
    content = parse_mapping(record)
    if content is None:
        return None
    content = {f.name: content[f.name] for f in fields(Task) if f.name in content}
    try:
        council = [parse_contact(fields_) for fields_ in content.get("council", ())]
        content["council"] = tuple(contact for contact in council if contact is not None)
        task = Task(**content)
    except TypeError:
        return None
    if task.charter:
        charter = parse_charter(task.charter)
        if charter is None:
            return None
        task = task.with_council(charter)
    times = (task.waiting_period, task.lease_ttl, task.created, task.deadline, task.stop_time, task.stall_limit)
    is_valid = (
        (bool(task.charter) or len(task.council) == len(council))
        and type(task.tolerates) is int
        and 1 <= task.tolerates <= MAX_TOLERATED
        and all(isinstance(text, str) for text in (task.task_id, task.kind, task.title, task.strategy, task.group))
        and all(is_number(n) and n >= 0 for n in (*times, task.hysteresis, task.value))
        and all(is_natural(n) for n in (task.generation, task.configuration))
        and type(task.priority) is int
        and abs(task.priority) <= MAX_PRIORITY
        and isinstance(task.preemptible, bool)
        and isinstance(task.exclusive, bool)
        and 0 < task.lease_ttl <= MAX_LEASE_TTL_S
        and are_capabilities(task.requirements)
        and are_properties(task.parameters)
    )
    return task if is_valid and task.task_id == record.name else None


def parse_tasks(records: Iterable[Record]) -> dict[str, Task]:
    """Decode the tasks in ``records``, by id.

    Each change of quorum members adds a record of the same task; the record with the newest members is used.
    """
    known = [(task, record.owner) for record in records if (task := parse_task(record)) is not None]
    known.sort(key=lambda pair: (pair[0].generation, pair[0].configuration, pair[0].created, pair[1]))
    return {task.task_id: task for task, _ in known}


def parse_member(record: Record) -> Member | None:
    """Decode the member report in a record, or None.

    The cost is None if it is invalid or the report has expired.
    """
    content = parse_mapping(record)
    if record.name != MEMBER or content is None:
        return None
    content = {f.name: content[f.name] for f in fields(Member) if f.name in content}
    if isinstance(content.get("value"), list):
        content["value"] = tuple(content["value"])
    try:
        member = Member(**content)
    except TypeError:
        return None
    texts = (member.uuid, member.name, member.status, member.assigned, member.digest, member.why, member.state)
    counts = (member.token, member.epoch, member.serial, member.load)
    places = (member.progress, member.angle, member.post)
    is_valid = (
        all(isinstance(text, str) for text in texts)
        and all(is_natural(count) for count in counts)
        and all(is_number(number) and number >= 0 for number in (member.age, member.valid_for))
        and all(place is None or is_number(place) for place in places)
        and isinstance(member.available, bool)
        and is_number(member.battery)
        and 0.0 <= member.battery <= 1.0
        and is_value(member.value)
        and is_choice(member.choice)
        and is_weight(member.weight)
        and is_weight(member.electorate)
    )
    if not is_valid or derive_node_id(record.owner).hex() != member.uuid:
        return None  # a node may report only for itself
    return member if is_bid(member.cost) and not is_stale(member, 0.0) else replace(member, cost=None)


def is_bid(cost: object) -> bool:
    """Return whether ``cost`` is a valid cost: finite and at least 0."""
    return is_number(cost) and cost >= 0  # type: ignore[operator]


def is_value(value: object) -> bool:
    """Return whether ``value`` is a valid number or place to agree on: a tuple of numbers within ``MAX_WEIGHT``."""
    return (
        isinstance(value, tuple)
        and len(value) <= MAX_COORDINATES
        and all(is_number(n) and abs(n) <= MAX_WEIGHT for n in value)
    )


def is_choice(choice: object) -> bool:
    """Return whether ``choice`` is a valid vote: a short printable text, empty for no vote."""
    return isinstance(choice, str) and len(choice) <= MAX_CHOICE_CHARACTERS and choice.isprintable()


def is_weight(weight: object) -> bool:
    """Return whether ``weight`` is valid as the weight of a vote or value."""
    return is_number(weight) and 0.0 <= weight <= MAX_WEIGHT  # type: ignore[operator]


def is_stale(member: Member, since: float) -> bool:
    """Return whether a report that arrived ``since`` seconds ago has expired."""
    return 0.0 < member.valid_for < member.age + since


def parse_result(record: Record, most: int = MAX_VALUE_BYTES) -> Result | None:
    """Decode the outcome in a record, or None."""
    content = parse_mapping(record, most)
    if record.name != RESULT or content is None:
        return None
    content = {f.name: content[f.name] for f in fields(Result) if f.name in content}
    try:
        content["bids"] = tuple((name, cost) for name, cost in content.get("bids", ()))
        result = Result(**content)
    except (TypeError, ValueError):
        return None
    is_valid = (
        result.outcome in OUTCOMES
        and isinstance(result.by, str)
        and is_number(result.took)
        and is_natural(result.token)
        and isinstance(result.why, str)
        and all(isinstance(name, str) and is_number(cost) for name, cost in result.bids)
    )
    return result if is_valid else None


def pack_done(result: Result, proof: bytes) -> bytes:
    """Return the value of an agent's record of the end of its task; ``proof`` is the proof of its lease."""
    return bytes(msgpack.packb({**vars(result), "proof": proof}))


def find_outcome(task: Task, records: Iterable[Record]) -> Result | None:
    """Return the outcome of ``task``, or None if it has not ended; of several results, the one with the highest token.

    A result is valid if it was written by a node that may order tasks (``RESULT``).  A result of an agent (``DONE``) is
    valid if a majority of the quorum members has signed that the task ended under its fencing token.
    """
    results = [
        result
        for record in records
        if (result := parse_result(record) if record.name == RESULT else _parse_done(task, record)) is not None
    ]
    return max(results, key=lambda result: result.rank, default=None)


def with_newest_council(task: Task, records: Iterable[Record]) -> Task:
    """Return ``task`` with the newest quorum members that are proved by ``records``, the records of its group."""
    pinned = parse_charter(task.charter)
    newest = pinned
    for record in records:
        charter = parse_charter(record.value) if record.name == COUNCIL and newest is not None else None
        if charter is None or newest is None or charter.configuration <= newest.configuration:
            continue
        if charter.first_council_id == newest.first_council_id and charter.is_genuine(task.task_id):
            newest = charter
    return task if newest is pinned or newest is None else task.with_council(newest)


def _parse_done(task: Task, record: Record) -> Result | None:
    if record.name != DONE or record.value is None or len(record.value) > MAX_DONE_BYTES:
        return None
    return _verify_done(task.task_id, task.charter, record)


@lru_cache(maxsize=64)  # checking signatures is slow, and the same record is read often
def _verify_done(task_id: str, charter: bytes, record: Record) -> Result | None:
    result = parse_result(replace(record, name=RESULT), MAX_DONE_BYTES)
    pinned, content = parse_charter(charter), parse_mapping(record, MAX_DONE_BYTES)
    if result is None or pinned is None or content is None:
        return None
    ending = parse_end_proof(content.get("proof"), pinned)
    is_proved = ending is not None and ending.is_genuine(task_id, derive_node_id(record.owner).hex(), result.token)
    return result if is_proved else None


def _non_default_fields(one: Task | Member) -> dict[str, Any]:
    """Return the fields that differ from their default; most fields of a record do not."""
    return {f.name: value for f in fields(one) if (value := getattr(one, f.name)) != f.default or f.default is MISSING}
