"""Rehearsed: the stage of a scenario in memory, with a laptop and three dogs that a seed replays."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred

from middleware.directory.presence import Device, devices_of
from middleware.faults.kinds import ASSIGN, CAUSE, Fault, begins_in
from middleware.tasks.task import TASKS, group_key, outcome_of, tasks_of
from swarmnode.asker import Refusal
from swarmnode.rehearsal import VirtualTeam

HERE_S = 2.0
ANSWER_S = 6.0


class RehearsedStage:
    """A virtual team whose every node allows faults; ``digest`` tells whether two runs were the same."""

    def __init__(self, seed: int) -> None:
        self.team = VirtualTeam(seed, faults=True)
        self._node = self.team.services[self.team.BOOTSTRAP].assembly.node
        self._watch = self._node.watch_devices(lambda records: None)
        self.team.clock.advance(HERE_S)

    def seconds(self) -> float:
        """The turned clock."""
        return self.team.clock.seconds()

    def wait(self, seconds: float) -> None:
        """Turn it."""
        self.team.clock.advance(seconds)

    def devices(self) -> list[Device]:
        """Who is there, as the laptop sees it."""
        return [device for device, _ in devices_of(self._watch.records)]

    def assign(self, task: str) -> str:
        """Let the laptop publish it."""
        return str(self._called(self._node.presence.device, ASSIGN, task))

    def cause(self, device: Device, fault: Fault) -> float:
        """Let the laptop ask for it."""
        return begins_in(self._called(device, CAUSE, fault.kind, fault.seconds, fault.amount or None))

    def is_over(self, task_id: str) -> bool:
        """Whether its outcome is recorded."""
        task = tasks_of(self._answer(self._node.entangled.get(TASKS))).get(task_id)
        records = self._answer(self._node.entangled.get(group_key(task_id)))
        return task is not None and outcome_of(task, records) is not None

    def digest(self) -> str:
        """The running hash over every delivery."""
        return self.team.board.digest()

    def stop(self) -> None:
        """End everything."""
        self.team.stop()

    def _called(self, device: Device, method: str, *arguments: Any) -> Any:
        record = next((record for each, record in devices_of(self._watch.records) if each.uuid == device.uuid), None)
        contact = None if record is None else self._node.contact_of(record)
        if contact is None:
            raise Refusal(f"{device.name} is not there")
        return self._answer(self._node.entangled.call(contact, method, *arguments, changes=True))

    def _answer(self, work: Deferred[Any]) -> Any:
        came: list[Any] = []
        problems: list[str] = []
        work.addCallbacks(came.append, lambda failure: problems.append(failure.getErrorMessage()))
        end = self.seconds() + ANSWER_S
        while not (came or problems) and self.seconds() < end:
            self.wait(0.01)
        if not came:
            raise Refusal(problems[0] if problems else "no answer")
        return came[0]
