"""Tasks: what is to be done, who can do it (Algorithm 4.4), and the record that says so.

A task is a team record under one key, written once by the node that submits it; each participant writes a slot of its
own under the task's group key, and the outcome is one more team record there.  So nothing is ever read, changed and
written back.  What is written by nodes that may not order tasks carries a proof: another council (``COUNCIL``) the
signatures of the council before it, the end of a task (``DONE``) those of the council that granted the lease.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import lru_cache
from typing import Any

import msgpack

from middleware.consensus.lease.charter import Charter, charter_of, ending_of
from middleware.consensus.lease.lease_codec import MAX_PROOF_BYTES
from middleware.directory.presence import Capabilities
from middleware.entangled.contact import Contact, unpacked
from middleware.entangled.identity import node_id
from middleware.entangled.record import Record, hashed_key
from middleware.entangled.value import (
    MAX_VALUE,
    are_capabilities,
    are_properties,
    bounded,
    is_number,
    is_whole,
    mapping_of,
)

TASKS = hashed_key("tasks")
COMPLETED, FAILED, CANCELLED = "COMPLETED", "FAILED", "CANCELLED"
OUTCOMES = (COMPLETED, FAILED, CANCELLED)
MAX_LEASE_TTL = 60.0
MAX_TOLERATED = 3
MEMBER = "member"
RESULT = "result"
ORDER = "order"
COUNCIL, DONE = "council", "done"
MAX_DONE = 2 * MAX_PROOF_BYTES
MAX_PRIORITY = 1000
MAX_CHOICE = 64
MAX_PLACES = 8
MAX_WEIGHT = 1e9
"""What is beyond it is no weight, and no number or place to agree on."""


def group_key(task_id: str) -> bytes:
    """The key under which the participants of a task report."""
    return hashed_key(f"task/{task_id}")


@dataclass(frozen=True)
class Task:
    """One thing to be done, by one device (``exclusive``), decided by ``strategy``.

    ``requirements`` maps capability names to properties that a device must at least have; ``waiting_period`` is how
    long the agents wait for each other's reports after the first one, in seconds; ``lease_ttl`` how long the right to
    act outlives a silent holder; ``hysteresis`` by which share a late report must be better to take the task over;
    ``council`` are the nodes whose majority grants that right, pinned when the task is made: so many that ``tolerates``
    of them may be lost at once, where the team has as many; ``configuration`` counts
    its changes.  ``charter`` is the proof of both (``middleware.consensus.lease.charter``).

    Of several tasks the one with the highest ``priority`` has an agent's body, then the oldest; ``preemptible`` ones
    are put aside for it and resumed.  ``deadline`` is in seconds after its creation, and ``stall_limit`` in seconds
    without progress until the right to act is given back (0: none).  ``stop_time`` is how long the robot needs to
    stand still, ``value`` what the task is worth, ``generation`` rises when an operator makes it anew, and ``group``
    names the tasks that are divided together.
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
        """This task with the council that ``charter`` names."""
        return replace(self, council=charter.members, configuration=charter.configuration, charter=charter.packed)

    def with_newer_council(self, other: Task) -> Task:
        """This task with the council of ``other``, where that is a later one of the same task."""
        mine, its = charter_of(self.charter), charter_of(other.charter)
        is_newer = mine is not None and its is not None and mine.pin == its.pin and len(mine.links) < len(its.links)
        return self.with_council(its) if is_newer and its is not None else self

    def packed(self) -> bytes:
        """The value of the task's record; what is as usual is left out, and what stands in its charter."""
        content = _unusual(self)
        if self.charter:
            content.pop("council", None)
            content.pop("configuration", None)
        elif self.council:
            content["council"] = [contact.packed() for contact in self.council]
        return bounded(bytes(msgpack.packb(content)))


@dataclass(frozen=True)
class Member:
    """What one participant reports to the others (its slot under the group key).

    ``cost`` is the measured distance in metres, or None while it has nothing to report; ``assigned`` the uuid of the
    agent that it computed as the consensus point; ``digest`` of the reports that it computed it from.

    ``epoch`` is the round of the task that the report and the decision belong to, and ``serial`` the place of the
    report in it: what is older than something known already is ignored.  A report counts for ``valid_for`` seconds
    (0: as long as its writer is present), of which ``age`` had passed when it was written.  ``available`` says whether
    the body is free for this task, ``load`` how many tasks the participant has, ``state`` where exactly it stands
    (``agents.state``), ``progress`` the share that is done, 0 to 1.  ``angle`` is the direction in which it stands as
    seen from the target, and ``post`` the one it goes to, in radians by the compass.

    What only some strategies go by: ``battery`` is the share that is left, ``value`` a number or a place to agree on
    (in metres), ``choice`` a vote, ``weight`` what both count, and ``electorate`` the weight of all that may vote.
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

    def packed(self) -> bytes:
        """The value of the member's record; what is as usual is left out."""
        return bounded(bytes(msgpack.packb(_unusual(self))))


@dataclass(frozen=True)
class Result:
    """How a task ended, one of ``OUTCOMES``, and ``why`` where that needs a word.

    ``bids`` are the reports that decided it, (name, metres) each.
    """

    outcome: str
    by: str
    took: float = 0.0
    token: int = 0
    bids: tuple[tuple[str, float], ...] = ()
    why: str = ""

    def packed(self) -> bytes:
        """The value of the result's record."""
        return bounded(bytes(msgpack.packb(vars(self))))

    @property
    def rank(self) -> tuple[int, str, str]:
        """Of several results the one with the highest rank holds: a total order, so that all agree."""
        return self.token, self.outcome, self.by


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
    content = mapping_of(record)
    if content is None:
        return None
    content = {f.name: content[f.name] for f in fields(Task) if f.name in content}
    try:
        council = [unpacked(fields_) for fields_ in content.get("council", ())]
        content["council"] = tuple(contact for contact in council if contact is not None)
        task = Task(**content)
    except TypeError:
        return None
    if task.charter:
        charter = charter_of(task.charter)
        if charter is None:
            return None
        task = task.with_council(charter)
    times = (task.waiting_period, task.lease_ttl, task.created, task.deadline, task.stop_time, task.stall_limit)
    lawful = (
        (bool(task.charter) or len(task.council) == len(council))
        and type(task.tolerates) is int
        and 1 <= task.tolerates <= MAX_TOLERATED
        and all(isinstance(text, str) for text in (task.task_id, task.kind, task.title, task.strategy, task.group))
        and all(is_number(n) and n >= 0 for n in (*times, task.hysteresis, task.value))
        and all(is_whole(n) for n in (task.generation, task.configuration))
        and type(task.priority) is int
        and abs(task.priority) <= MAX_PRIORITY
        and isinstance(task.preemptible, bool)
        and isinstance(task.exclusive, bool)
        and 0 < task.lease_ttl <= MAX_LEASE_TTL
        and are_capabilities(task.requirements)
        and are_properties(task.parameters)
    )
    return task if lawful and task.task_id == record.name else None


def tasks_of(records: Iterable[Record]) -> dict[str, Task]:
    """The tasks in ``records`` by their ids.

    Of several records of one task (whoever changes its council writes one more) the newest council's counts.
    """
    known = [(task, record.owner) for record in records if (task := task_of(record)) is not None]
    known.sort(key=lambda pair: (pair[0].generation, pair[0].configuration, pair[0].created, pair[1]))
    return {task.task_id: task for task, _ in known}


def member_of(record: Record) -> Member | None:
    """The member report in a record, or None.

    A cost that is no finite distance, or is older than it is valid for, counts as "nothing to report".
    """
    content = mapping_of(record)
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
    lawful = (
        all(isinstance(text, str) for text in texts)
        and all(is_whole(count) for count in counts)
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
    if not lawful or node_id(record.owner).hex() != member.uuid:
        return None  # nobody reports for another
    return member if is_bid(member.cost) and not is_stale(member, 0.0) else replace(member, cost=None)


def is_bid(cost: object) -> bool:
    """Whether ``cost`` is one that can win: finite, not negative, and no larger than people can be shown."""
    return is_number(cost) and cost >= 0  # type: ignore[operator]


def is_value(value: object) -> bool:
    """Whether ``value`` is a number or a place to agree on: a tuple of finite numbers, none of them enormous."""
    return (
        isinstance(value, tuple)
        and len(value) <= MAX_PLACES
        and all(is_number(n) and abs(n) <= MAX_WEIGHT for n in value)
    )


def is_choice(choice: object) -> bool:
    """Whether ``choice`` is an option that people can be shown, or "" for none."""
    return isinstance(choice, str) and len(choice) <= MAX_CHOICE and choice.isprintable()


def is_weight(weight: object) -> bool:
    """Whether ``weight`` is what a vote or a value may count."""
    return is_number(weight) and 0.0 <= weight <= MAX_WEIGHT  # type: ignore[operator]


def is_stale(member: Member, since: float) -> bool:
    """Whether a report that came ``since`` seconds ago is older than it is valid for."""
    return 0.0 < member.valid_for < member.age + since


def result_of(record: Record, most: int = MAX_VALUE) -> Result | None:
    """The outcome in a record, or None."""
    content = mapping_of(record, most)
    if record.name != RESULT or content is None:
        return None
    content = {f.name: content[f.name] for f in fields(Result) if f.name in content}
    try:
        content["bids"] = tuple((name, cost) for name, cost in content.get("bids", ()))
        result = Result(**content)
    except (TypeError, ValueError):
        return None
    lawful = (
        result.outcome in OUTCOMES
        and isinstance(result.by, str)
        and is_number(result.took)
        and is_whole(result.token)
        and isinstance(result.why, str)
        and all(isinstance(name, str) and is_number(cost) for name, cost in result.bids)
    )
    return result if lawful else None


def done_packed(result: Result, proof: bytes) -> bytes:
    """The value of the record in which an agent says how the task ended that it held, with the proof that it did."""
    return bytes(msgpack.packb({**vars(result), "proof": proof}))


def outcome_of(task: Task, records: Iterable[Record]) -> Result | None:
    """How ``task`` ended, or None while it is open; of several results the highest token holds.

    Those count that were written by who may order tasks (``RESULT``), and those of an agent of which a majority of the
    council says that it ended the task under its token (``DONE``).
    """
    results = [
        result
        for record in records
        if (result := result_of(record) if record.name == RESULT else _done(task, record)) is not None
    ]
    return max(results, key=lambda result: result.rank, default=None)


def council_of(task: Task, records: Iterable[Record]) -> Task:
    """``task`` with its newest council, as far as the records of its group prove one."""
    pinned = charter_of(task.charter)
    newest = pinned
    for record in records:
        charter = charter_of(record.value) if record.name == COUNCIL and newest is not None else None
        if charter is None or newest is None or charter.configuration <= newest.configuration:
            continue
        if charter.pin == newest.pin and charter.is_genuine(task.task_id):
            newest = charter
    return task if newest is pinned or newest is None else task.with_council(newest)


def _done(task: Task, record: Record) -> Result | None:
    if record.name != DONE or record.value is None or len(record.value) > MAX_DONE:
        return None
    return _done_of(task.task_id, task.charter, record)


@lru_cache(maxsize=64)  # signatures are checked, and the same record is read again and again
def _done_of(task_id: str, charter: bytes, record: Record) -> Result | None:
    result = result_of(replace(record, name=RESULT), MAX_DONE)
    pinned, content = charter_of(charter), mapping_of(record, MAX_DONE)
    if result is None or pinned is None or content is None:
        return None
    ending = ending_of(content.get("proof"), pinned)
    is_proved = ending is not None and ending.is_genuine(task_id, node_id(record.owner).hex(), result.token)
    return result if is_proved else None


def _unusual(one: Task | Member) -> dict[str, Any]:
    """The fields that are not at their default; records are small, and there are many fields."""
    return {f.name: value for f in fields(one) if (value := getattr(one, f.name)) != f.default or f.default is MISSING}
