"""The devices, tasks and stops in the records of one node (thesis, Algorithm 4.3).  Pure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from middleware.consensus.decision_record import decision_records_key, parse_decision_record
from middleware.diagnostics.explanation import Explanation, explain_decisions
from middleware.directory.presence import DEVICES, Device, parse_devices
from middleware.entangled.record import Record
from middleware.stop.stop_state import STOPS_KEY, collect_stops
from middleware.tasks.order import PAUSE, find_newest_order
from middleware.tasks.task import (
    TASKS,
    Member,
    Result,
    Task,
    find_outcome,
    find_unmet_requirements,
    group_key,
    parse_member,
    with_newest_council,
)
from middleware.tasks.task import parse_tasks as tasks_in

Read = Callable[[bytes], list[Record]]
"""Returns the records under a key, from a store or from watches."""


@dataclass(frozen=True)
class Progress:
    """The state of one task.

    ``members`` are the reports of its agents, and ``outcome`` is its result (None if it has not ended).  ``paused_by``
    is the device whose operator paused the task ("" if it is not paused).  ``council`` contains the addresses of the
    acceptors of its lease.
    """

    members: tuple[Member, ...]
    outcome: Result | None
    paused_by: str
    council: tuple[str, ...]


class TeamView:
    """The team as described by the records from ``read``; each property reads the records again."""

    def __init__(self, read: Read) -> None:
        self._read = read

    @property
    def devices(self) -> list[Device]:
        """The present devices, in the order of joining."""
        return [device for device, _ in parse_devices(self._read(DEVICES))]

    @property
    def tasks(self) -> list[Task]:
        """All tasks, the newest first."""
        return sorted(tasks_in(self._read(TASKS)).values(), key=lambda task: (-task.created, task.task_id))

    @property
    def open_tasks(self) -> list[Task]:
        """The tasks without an outcome, the newest first."""
        return [task for task in self.tasks if find_outcome(task, self._read(group_key(task.task_id))) is None]

    @property
    def stops(self) -> dict[str, str]:
        """The stops in force: the id in hex, and the operator."""
        return {stop.hex(): by for stop, by in collect_stops(self._read(STOPS_KEY)).items()}

    def find_task(self, task_id: str) -> Task | None:
        """Return a task, or None if it is unknown."""
        return tasks_in(self._read(TASKS)).get(task_id)

    def list_members(self, task_id: str) -> list[Member]:
        """Return the reports of a task's agents."""
        return [member for record in self._read(group_key(task_id)) if (member := parse_member(record)) is not None]

    def find_progress(self, task: Task) -> Progress:
        """Return the state of ``task``."""
        records = self._read(group_key(task.task_id))
        outcome, order = find_outcome(task, records), find_newest_order(records)
        is_paused = outcome is None and order is not None and order.word == PAUSE
        return Progress(
            tuple(member for record in records if (member := parse_member(record)) is not None),
            outcome,
            order.by if is_paused and order is not None else "",
            tuple(str(contact.address) for contact in with_newest_council(task, records).council),
        )

    def explain(self, task_id: str) -> Explanation:
        """Explain the choice of the task's agent from the decision records of the agents."""
        records = [
            decision
            for record in self._read(decision_records_key(task_id))
            if (decision := parse_decision_record(record))
        ]
        return explain_decisions(decision for decision in records if decision.task == task_id)

    def find_unable_devices(self, task: Task) -> dict[str, list[str]]:
        """Return the unmet requirements of ``task``, by the name of the device that lacks them (Algorithm 4.4)."""
        reasons = {
            device.name: find_unmet_requirements(device.capabilities, task.requirements) for device in self.devices
        }
        return {name: unmet for name, unmet in reasons.items() if unmet}

    def find_device(self, uuid: str) -> Device | None:
        """Return a device, or None if it is not present."""
        return next((device for device in self.devices if device.uuid == uuid), None)

    def find_name(self, uuid: str) -> str:
        """Return the name of a device, or the start of its uuid if it is not present."""
        device = self.find_device(uuid)
        return uuid[:8] if device is None else device.name

    def find_record(self, uuid: str) -> Record | None:
        """Return the record of a device, or None if it is not present."""
        return next((record for device, record in parse_devices(self._read(DEVICES)) if device.uuid == uuid), None)
