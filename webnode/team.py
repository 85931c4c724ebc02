"""TeamDesk: an operator's wishes, carried out over the node (thesis, Algorithm 4.4 and the Run Demo button)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from middleware.entangled.errors import EntangledError
from middleware.entangled.record import Record
from middleware.entangled.replication.watch import Watch
from middleware.node import CAMERA, SwarmNode
from middleware.order import PAUSE, RESUME, Order
from middleware.presence import DEVICES, devices_of
from middleware.tasks import CANCELLED, TASKS, Result, Task, group_key, outcome_of, tasks_of
from middleware.verdict import verdicts_key
from webnode.errors import Refusal
from webnode.ledger import refused_by

PLACING = 5.0
"""Seconds between Run Demo and the target's appearance: it is placed while the robots search (thesis, section 5)."""
DIVIDED = "group_optimal"
"""The strategy of a task of a group whose catalogue entry says the nearest, which is for one task."""


class YardHand(Protocol):
    """What the desk needs of a yard, where there is one."""

    @property
    def snapshot(self) -> Mapping[str, Any] | None:
        """The newest view from above."""

    def place_target(self, x: float, y: float) -> Deferred[bool]:
        """Put the target at a place."""

    def place_target_at_random(self) -> Deferred[bool]:
        """Put the target anywhere."""

    def clear_target(self) -> Deferred[bool]:
        """Take the target away."""


class TeamDesk:
    """The desk of a running team; ``predefined`` and ``demo`` come from the catalogue of tasks.

    ``version`` is another number whenever what is known has changed.
    """

    _log = Logger()

    def __init__(
        self, node: SwarmNode, predefined: Mapping[str, Task], demo: str, yard: YardHand | None = None
    ) -> None:
        self._node = node
        self._predefined = predefined
        self._demo = demo
        self._yard = yard
        self._groups: dict[str, Watch] = {}
        self._reasons: dict[str, Watch] = {}
        self.version = 0
        self._devices = node.watch_devices(self._count, keep=True)
        self._tasks = node.watch_tasks(self._follow, keep=True)

    # -- what is known ----------------------------------------------------------------------------------------------

    def read(self, key: bytes) -> list[Record]:
        """The records under ``key``, of the keys that the page shows, as they are watched now."""
        if key == DEVICES:
            return self._devices.records
        if key == TASKS:
            return self._tasks.records
        watches = (*self._groups.values(), *self._reasons.values())
        return next((watch.records for watch in watches if watch.key == key), [])

    def watch(self, uuid: str, on_frame: Callable[[int, bytes], None]) -> Callable[[], None]:
        """Look through the camera of the device ``uuid`` until what is returned is called."""
        record = self._record_of(uuid)
        contact = None if record is None else self._node.contact_of(record)
        if contact is None:
            raise Refusal("device", "there is no such device", "choose one of /api/v1/devices", 404)
        return self._node.streams.look(contact, CAMERA, on_frame)

    def yard(self) -> Mapping[str, Any] | None:
        """The newest view from above, or None."""
        return None if self._yard is None else self._yard.snapshot

    def catalogue(self) -> Sequence[Mapping[str, Any]]:
        """The predefined tasks."""
        return [
            {"name": name, "title": task.title, "requirements": task.requirements}
            for name, task in self._predefined.items()
        ]

    # -- what is wished ---------------------------------------------------------------------------------------------

    def run_demo(self) -> str:
        """Assign the demonstration's task; where there is a yard, the target is placed while the robots search."""
        for task in self._open_tasks():
            self.cancel(task.task_id)
        if self._yard is not None:
            self._quietly(self._yard.clear_target())
            self._node.clock.callLater(PLACING, self._place)
        return str(self.assign(self._demo)["id"])

    def assign(self, name: str, tolerates: int = 1, group: str = "") -> dict[str, Any]:
        """Publish a predefined task; the devices that can do it take it up by themselves.

        Those of one ``group`` are divided together.
        """
        template = self._predefined.get(name)
        if template is None:
            known = ", ".join(sorted(self._predefined))
            raise Refusal("name", f"there is no predefined task {name!r}", f"choose one of {known}", 404)
        task_id = self._node.rng.randbytes(6).hex()
        task = replace(template, task_id=task_id, created=self._node.wall(), tolerates=tolerates)
        if group:
            strategy = DIVIDED if task.strategy == Task.strategy else task.strategy
            task = replace(task, group=group, strategy=strategy)
        devices = [device for device, _ in devices_of(self._devices.records)]
        refused = refused_by(task, devices)
        self._quietly(Deferred.fromCoroutine(self._node.submit(task)))
        return {"id": task_id, "able": [d.name for d in devices if d.name not in refused], "refused": refused}

    def cancel(self, task_id: str) -> None:
        """Record that the task is cancelled; whoever is at it stops."""
        result = Result(CANCELLED, self._node.presence.device.name)
        task = tasks_of(self._tasks.records).get(task_id)
        if task is None:
            return self._quietly(self._node.conclude(task_id, result))
        self._quietly(Deferred.fromCoroutine(self._node.cancel(task, result)))

    def pause(self, task_id: str) -> None:
        """Record that the task is to rest; whoever is at it stops, and is free for others."""
        self._order(task_id, PAUSE)

    def resume(self, task_id: str) -> None:
        """Record that the task is to go on."""
        self._order(task_id, RESUME)

    def message(self, uuid: str, text: str) -> None:
        """Send a text to one device, or to all."""
        for device, record in devices_of(self._devices.records):
            if uuid in ("", device.uuid):
                self._call(record, "device.message", text)

    def disconnect(self, uuid: str, seconds: float) -> None:
        """Ask a device to leave the network for a while, as if it had failed."""
        record = self._record_of(uuid)
        if record is not None:
            self._call(record, "device.disconnect", seconds)

    def move_target(self, x: float, y: float) -> Any:
        """Put the target at (x, y)."""
        return self._with_yard().place_target(x, y).addErrback(_refused)

    def clear_target(self) -> Any:
        """Take the target away."""
        return self._with_yard().clear_target().addErrback(_refused)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _follow(self, records: list[Record]) -> None:
        self._count(records)
        for task_id in tasks_of(records):
            if task_id not in self._groups:
                self._groups[task_id] = self._node.watch_group(task_id, self._count, keep=True)
                self._reasons[task_id] = self._node.entangled.watch(verdicts_key(task_id), self._count, keep=True)

    def _count(self, records: list[Record]) -> None:
        self.version += 1

    def _order(self, task_id: str, word: str) -> None:
        order = Order(word, self._node.presence.device.name, self._node.wall())
        self._quietly(self._node.order(task_id, order.packed()))

    def _open_tasks(self) -> list[Task]:
        tasks = tasks_of(self._tasks.records).values()
        return [task for task in tasks if outcome_of(self.read(group_key(task.task_id))) is None]

    def _record_of(self, uuid: str) -> Record | None:
        return next((record for device, record in devices_of(self._devices.records) if device.uuid == uuid), None)

    def _call(self, record: Record, method: str, argument: object) -> None:
        contact = self._node.contact_of(record)
        if contact is not None:
            self._quietly(self._node.entangled.endpoint.ask(contact, method, argument, changes=True))

    def _with_yard(self) -> YardHand:
        if self._yard is None:
            raise Refusal("target", "this node has no yard", "start one, or name it in the settings", 409)
        return self._yard

    def _place(self) -> None:
        if self._yard is not None and self._node.running:
            self._quietly(self._yard.place_target_at_random())

    def _quietly(self, work: Deferred[Any]) -> None:
        def ended(failure: Any) -> None:
            if failure.check(EntangledError) is None:
                self._log.warn("a wish was not granted: {error}", error=failure.getErrorMessage())

        work.addErrback(ended)


def _refused(failure: Any) -> None:
    raise Refusal("target", failure.getErrorMessage(), "choose another place, or look whether the yard runs", 409)
