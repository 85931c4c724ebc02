"""Carry out an operator's requests on the team (thesis, Algorithm 4.4 and the Run Demo button)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

from twisted.internet.defer import Deferred, DeferredList, fail
from twisted.logger import Logger

from middleware.directory.presence import Device
from middleware.entangled.errors import EntangledError, Refused
from middleware.entangled.record import Record
from middleware.frontend.client import TeamClient
from middleware.tasks.order import PAUSE, RESUME
from middleware.tasks.task import Task
from webnode.camera import OnFrame
from webnode.errors import Refusal

PLACE_TARGET_S = 5.0
"""Seconds between Run Demo and the target's placement: it appears while the robots search (thesis, section 5)."""
NEAREST_STRATEGY = Task.strategy
DIVIDED_STRATEGY = "group_optimal"
"""The strategy of a task in a group, if its catalogue entry names the nearest agent, which applies to one task."""
ANSWER_LIMIT_S = 1.5
"""Timeout of a device's reply to an order in seconds; less than the time limit of a route."""


class SimulatorControl(Protocol):
    """The operations of a robot simulator that ``TeamControl`` uses."""

    @property
    def snapshot(self) -> Mapping[str, Any] | None:
        """The newest map."""

    def place_target(self, x: float, y: float) -> Deferred[bool]:
        """Put the target at a position."""

    def place_target_later(self, seconds: float) -> Deferred[bool]:
        """Let the simulator put the target at a random position after ``seconds``."""

    def clear_target(self) -> Deferred[bool]:
        """Remove the target."""

    def move_dog(self, name: str, x: float, y: float, heading: float) -> Deferred[bool]:
        """Move a robot."""


class TeamControl:
    """An operator's access to a running team; ``predefined`` and ``demo`` come from the catalogue of tasks.

    Every method is called on the reactor's thread and returns immediately, or returns a Deferred that fires soon.  It
    raises ``Refusal`` for an impossible request; the effect of a request shows in the state, not in the answer.
    """

    _log = Logger()

    def __init__(
        self, client: TeamClient, predefined: Mapping[str, Task], demo: str, simulator: SimulatorControl | None = None
    ) -> None:
        self._client = client
        self._view = client.view
        self._predefined = predefined
        self._demo = demo
        self._simulator = simulator

    # -- queries ----------------------------------------------------------------------------------------------------

    def read(self, key: bytes) -> list[Record]:
        """Return the watched records under ``key``, one of the keys that the page shows."""
        return self._client.read(key)

    def stream_camera(self, uuid: str, on_frame: OnFrame) -> Callable[[], None]:
        """Stream the camera of the device ``uuid`` until the returned function is called."""
        contact = self._client.find_contact(uuid)
        if contact is None:
            raise Refusal("device", "unknown device", "choose one of /api/v1/devices", 404)
        return self._client.stream_camera(contact, on_frame)

    def get_map(self) -> Mapping[str, Any] | None:
        """Return the newest map of the robot simulator, or None without one.

        ``{"walls": [w, h], "dogs": [{"name", "x", "y", "heading", "stripes"}], "target": {"x", "y", "radius"} |
        None}``; metres and radians, origin in the lower left corner.
        """
        return None if self._simulator is None else self._simulator.snapshot

    def list_predefined(self) -> Sequence[Mapping[str, Any]]:
        """Return the predefined tasks, each as ``{"name", "title", "requirements"}``."""
        return [
            {"name": name, "title": task.title, "requirements": task.requirements}
            for name, task in self._predefined.items()
        ]

    # -- orders -----------------------------------------------------------------------------------------------------

    def run_demo(self, task_id: str = "") -> Any:
        """Assign the demonstration's task; with a simulator, the target is placed while the robots search.

        Returns the task's id.  With ``task_id`` it returns a Deferred of it, and does nothing if that task exists.
        """
        if task_id:
            found = self._client.find_task(task_id)
            return found.addCallback(lambda task: task_id if task else self._start_demo(task_id))
        return self._start_demo(self._client.new_task_id())

    def assign(self, name: str, tolerates: int = 1, group: str = "", task_id: str = "") -> Any:
        """Publish a predefined task; ``tolerates`` members of its council may fail at the same time.

        Tasks of one ``group`` are assigned jointly, one to each device.  Returns ``{"id", "able": [names], "refused":
        {name: [reasons]}}``.  With ``task_id`` it returns a Deferred, and does not publish a task that exists, because
        another web node may have published it for the same request.
        """
        template = replace(self._find_template(name, group), tolerates=tolerates)
        if task_id:
            found = self._client.find_task(task_id)
            return found.addCallback(lambda task: self._describe(task) if task else self._publish(template, task_id))
        return self._publish(template, self._client.new_task_id())

    def preview(self, name: str, group: str = "") -> dict[str, Any]:
        """Return which devices can take a predefined task and why others cannot; sends nothing.

        ``{"able": [{"uuid", "name", "busy"}], "refused": {name: [reasons]}, "likely": name | None, "together": [{"id",
        "title"}]}``; ``busy`` is the current task of a device, ``likely`` the device that would probably take it by
        present reports, ``together`` the open tasks of ``group`` that would be assigned jointly with it.
        """
        task = self._find_template(name, group)
        refused = self._view.find_unable_devices(task)
        titles = {each.task_id: each.title for each in self._view.tasks}
        able = [device for device in self._view.devices if device.name not in refused]
        rows = [
            {"uuid": d.uuid, "name": d.name, "busy": titles.get(d.task, "another task" * bool(d.task))} for d in able
        ]
        likely = self._find_likely(task, [device.uuid for device in able])
        # The agents' rule: tasks of one group with equal requirements and strategy are assigned jointly.
        together = [
            {"id": other.task_id, "title": other.title}
            for other in self._view.open_tasks
            if group and (other.group, other.strategy, other.requirements) == (group, task.strategy, task.requirements)
        ]
        return {"able": rows, "refused": refused, "likely": likely, "together": together}

    def cancel(self, task_id: str) -> None:
        """Record that the task is cancelled; its devices stop."""
        self._log_failure(self._client.cancel(task_id))

    def pause(self, task_id: str) -> None:
        """Record that the task is paused; its devices stop and are free for other tasks."""
        self._log_failure(self._client.order(task_id, PAUSE))

    def resume(self, task_id: str) -> None:
        """Record that the task is resumed."""
        self._log_failure(self._client.order(task_id, RESUME))

    def send_message(self, uuid: str, text: str) -> Deferred[dict[str, Any]]:
        """Send a text to one device, or to all if ``uuid`` is empty.

        Fires with ``{"delivered": [names], "failed": {name: reason}}``; for one device a failure is a ``Refusal``.
        """
        delivered: list[str] = []
        failed: dict[str, str] = {}

        def send(device: Device) -> Deferred[Any]:
            call = self.call(device.uuid, "device.message", text)
            return call.addCallback(lambda _: delivered.append(device.name))

        def note_failure(failure: Any, name: str) -> None:
            failure.trap(Refusal)
            failed[name] = failure.value.problem

        if uuid:
            call = self.call(uuid, "device.message", text)
            return call.addCallback(lambda _: {"delivered": [self._view.find_name(uuid)], "failed": failed})
        all_sent = DeferredList([send(device).addErrback(note_failure, device.name) for device in self._view.devices])
        return all_sent.addCallback(lambda _: {"delivered": sorted(delivered), "failed": failed})

    def disconnect(self, uuid: str, seconds: float) -> Deferred[Any]:
        """Ask a device to leave the network for ``seconds``, as if it had failed; fires when it confirms."""
        return self.call(uuid, "device.disconnect", seconds)

    def call(
        self,
        uuid: str,
        method: str,
        *arguments: object,
        refused: Callable[[Refused], Refusal | None] = lambda refused: None,
    ) -> Deferred[Any]:
        """Call a method of a device; fires with its answer, fails with ``Refusal``.

        409: the device has left, leaves during the call, or refuses; 504: it does not answer.  ``refused`` may
        translate a refusal.
        """
        name = self._view.find_name(uuid)
        if self._client.find_contact(uuid) is None:
            return fail(Refusal("device", f"{name} has left the network", "choose one of /api/v1/devices", 409))
        until = self._client.clock.seconds() + ANSWER_LIMIT_S
        call = self._client.call(uuid, method, *arguments, timeout=ANSWER_LIMIT_S, changes=True)
        return call.addErrback(self._explain_failure, uuid, name, until, refused)

    def move_target(self, x: float, y: float) -> Deferred[Any]:
        """Put the target at (x, y), metres on the simulator's map."""
        return self._require_simulator().place_target(x, y).addErrback(_raise_refusal)

    def clear_target(self) -> Deferred[Any]:
        """Remove the target."""
        return self._require_simulator().clear_target().addErrback(_raise_refusal)

    def move_robot(self, name: str, x: float, y: float, heading: float) -> Deferred[Any]:
        """Move a simulated robot to (x, y), facing ``heading`` (radians)."""
        return self._require_simulator().move_dog(name, x, y, heading).addErrback(_raise_refusal, name)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _start_demo(self, task_id: str) -> str:
        for task in self._view.open_tasks:
            self.cancel(task.task_id)
        if self._simulator is not None:
            self._log_failure(self._simulator.clear_target())
            # The simulator starts the timer for the target itself, because this node may fail before it expires.
            self._log_failure(self._simulator.place_target_later(PLACE_TARGET_S))
        # The acting device may fail together with the node that serves the page.
        template = replace(self._find_template(self._demo), tolerates=2)
        return str(self._publish(template, task_id)["id"])

    def _publish(self, template: Task, task_id: str) -> dict[str, Any]:
        task, stored = self._client.submit(template, task_id)
        self._log_failure(stored)
        return self._describe(task)

    def _describe(self, task: Task) -> dict[str, Any]:
        refused = self._view.find_unable_devices(task)
        able = [device.name for device in self._view.devices if device.name not in refused]
        return {"id": task.task_id, "able": able, "refused": refused}

    def _find_template(self, name: str, group: str = "") -> Task:
        template = self._predefined.get(name)
        if template is None:
            known = ", ".join(sorted(self._predefined))
            raise Refusal("name", f"unknown predefined task {name!r}", f"choose one of {known}", 404)
        if not group:
            return template
        return replace(
            template,
            group=group,
            strategy=DIVIDED_STRATEGY if template.strategy == NEAREST_STRATEGY else template.strategy,
        )

    def _find_likely(self, task: Task, able: Sequence[str]) -> str | None:
        """Return the nearest of ``able`` by the reports to open tasks of the same kind; None without reports."""
        costs: dict[str, float] = {}
        for other in self._view.open_tasks:
            if (other.kind, other.parameters) == (task.kind, task.parameters):
                for member in self._view.list_members(other.task_id):
                    if member.cost is not None and member.uuid in able:
                        costs[member.uuid] = min(member.cost, costs.get(member.uuid, math.inf))
        nearest = min(costs, key=lambda uuid: (costs[uuid], uuid), default=None)
        return None if nearest is None else self._view.find_name(nearest)

    def _explain_failure(
        self, failure: Any, uuid: str, name: str, until: float, refused: Callable[[Refused], Refusal | None]
    ) -> Deferred[Any]:
        """Convert a failed call of a device to a ``Refusal``."""
        failure.trap(EntangledError)
        if failure.check(Refused):
            raise refused(failure.value) or Refusal(
                "device", f"{name} refused: {failure.getErrorMessage()}", "check the request", 409
            )
        silent: Deferred[Any] = Deferred()

        def decide() -> None:
            remedy = "check whether the request took effect, then try again"
            refusal = Refusal("device", f"{name} did not answer", remedy, 504)
            if self._view.find_device(uuid) is None:
                refusal = Refusal("device", f"{name} left during the request", "wait until the device is back", 409)
            silent.errback(refusal)

        # The device's presence record outlives it for a moment; its expiry tells a departure from silence.
        self._client.clock.callLater(max(0.0, until - self._client.clock.seconds()), decide)
        return silent

    def _require_simulator(self) -> SimulatorControl:
        if self._simulator is None:
            raise Refusal(
                "target",
                "this node has no robot simulator",
                "start a simulator, and set its address in [web] yard",
                409,
            )
        return self._simulator

    def _log_failure(self, work: Deferred[Any]) -> None:
        def ended(failure: Any) -> None:
            if failure.check(EntangledError) is None:
                self._log.warn("a request failed: {error}", error=failure.getErrorMessage())

        work.addErrback(ended)


def _raise_refusal(failure: Any, what: str = "target") -> None:
    raise Refusal(what, failure.getErrorMessage(), "choose another position, or check that the simulator runs", 409)
