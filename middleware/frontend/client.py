"""The requests that a user interface makes through one node (thesis, Algorithm 4.4)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred, fail

from middleware.consensus.decision_record import decision_records_key
from middleware.directory.presence import DEVICES
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError, NoAnswer
from middleware.entangled.record import Record
from middleware.entangled.replication.watch import Watch
from middleware.frontend.team_view import TeamView
from middleware.node import CAMERA, SwarmNode
from middleware.stop.stop_state import STOPS_KEY
from middleware.tasks.order import Order
from middleware.tasks.task import CANCELLED, TASKS, Result, Task, parse_tasks

LOOKUP_S = 1.0
"""Timeout in seconds of the lookup of a task."""


class TeamClient:
    """Watches the team through ``node``, calls devices, and gives orders about tasks.

    ``view`` decodes the watched records, ``version`` is the number of their changes, and ``clock`` is the clock of the
    node.
    """

    def __init__(self, node: SwarmNode) -> None:
        self.clock = node.clock
        self._node = node
        self._tasks_watched: dict[str, tuple[Watch, Watch]] = {}
        self.version = 0
        self.view = TeamView(self.read)
        self._devices = node.watch_devices(self._count_change, keep=True)
        self._tasks = node.watch_tasks(self._watch_tasks, keep=True)
        node.stop_state.follow()

    @property
    def name(self) -> str:
        """The name of this node's device."""
        return self._node.presence.device.name

    def read(self, key: bytes) -> list[Record]:
        """Return the watched records under ``key``: devices, tasks, stops, or a task's group or decision records."""
        if key == DEVICES:
            return self._devices.records
        if key == TASKS:
            return self._tasks.records
        if key == STOPS_KEY:
            return self._node.stop_state.records
        watches = (watch for pair in self._tasks_watched.values() for watch in pair)
        return next((watch.records for watch in watches if watch.key == key), [])

    # -- devices ----------------------------------------------------------------------------------------------------

    def find_contact(self, uuid: str) -> Contact | None:
        """Return the contact of a device, or None if it is not present."""
        record = self.view.find_record(uuid)
        return None if record is None else self._node.find_contact(record)

    def call(self, uuid: str, method: str, *arguments: object, timeout: float, changes: bool = False) -> Deferred[Any]:
        """Call a method of a device; fail with ``EntangledError``, or ``NoAnswer`` if the device is not present.

        :param timeout: seconds
        :param changes: whether the call changes something, so that it must not be executed twice
        """
        contact = self.find_contact(uuid)
        if contact is None:
            return fail(NoAnswer(f"{self.view.find_name(uuid)} is not present"))
        return self._node.entangled.endpoint.ask(contact, method, *arguments, timeout=timeout, changes=changes)

    def stream_camera(self, contact: Contact, on_frame: Callable[[int, bytes, float], None]) -> Callable[[], None]:
        """Receive the pictures of a device's camera until the returned function is called."""
        return self._node.streams.view(contact, CAMERA, on_frame)

    # -- stops ------------------------------------------------------------------------------------------------------

    def stop_all(self, by: str) -> Deferred[dict[str, str]]:
        """Stop every device; fire with the answer of each device by uuid."""
        return self._node.stop_state.stop(by, self._contacts())

    def release(self, stops: Iterable[bytes], by: str) -> Deferred[dict[str, str]]:
        """Release ``stops``; fire with the answer of each device by uuid."""
        return self._node.stop_state.release(list(stops), by, self._contacts())

    # -- tasks ------------------------------------------------------------------------------------------------------

    def new_task_id(self) -> str:
        """Return an unused task id."""
        return self._node.rng.randbytes(6).hex()

    def find_task(self, task_id: str) -> Deferred[Task | None]:
        """Fire with the task that has that id, or None.

        The team is queried, because a task that another node has just published may not have been pushed to this node
        yet. If no answer arrives within ``LOOKUP_S``, the locally watched records are used.
        """
        found: Deferred[Task | None] = Deferred()

        def answer(records: Iterable[Record]) -> None:
            if not found.called:
                found.callback(parse_tasks([*self._tasks.records, *records]).get(task_id))

        if self.view.find_task(task_id) is not None:
            answer(())
            return found
        cancel = self._node.later(LOOKUP_S, answer, ())
        self._node.entangled.get(TASKS).addErrback(_ignore_error).addCallback(answer).addBoth(lambda _: cancel())
        return found

    def submit(self, template: Task, task_id: str) -> tuple[Task, Deferred[Any]]:
        """Publish a task now; return the task, and a Deferred that fires when the task is stored."""
        task = replace(template, task_id=task_id, created=self._node.wall())
        return task, Deferred.fromCoroutine(self._node.submit(task))

    def cancel(self, task_id: str) -> Deferred[Any]:
        """Record that the task is cancelled, so its agents stop."""
        result = Result(CANCELLED, self.name)
        task = self.view.find_task(task_id)
        if task is None:
            return self._node.record_result(task_id, result)
        return Deferred.fromCoroutine(self._node.cancel(task, result))

    def order(self, task_id: str, word: str) -> Deferred[Any]:
        """Pause or resume a task (``middleware.tasks.order``)."""
        return self._node.record_order(task_id, Order(word, self.name, self._node.wall()).pack())

    # -- inside -----------------------------------------------------------------------------------------------------

    def _contacts(self) -> list[Contact]:
        contacts = [self.find_contact(device.uuid) for device in self.view.devices]
        return [contact for contact in contacts if contact is not None]

    def _watch_tasks(self, records: list[Record]) -> None:
        self._count_change(records)
        for task_id in parse_tasks(records):
            if task_id not in self._tasks_watched:
                self._tasks_watched[task_id] = (
                    self._node.watch_group(task_id, self._count_change, keep=True),
                    self._node.entangled.watch(decision_records_key(task_id), self._count_change, keep=True),
                )

    def _count_change(self, records: list[Record]) -> None:
        self.version += 1


def _ignore_error(failure: Any) -> list[Record]:
    failure.trap(EntangledError)
    return []
