"""The agent of one device: joins the tasks that its robot can do and turns observations into actions."""

from __future__ import annotations

import random
from typing import Any

from twisted.application.service import Service
from twisted.internet.defer import Deferred, DeferredList
from twisted.internet.interfaces import IDelayedCall, IReactorTime

from agents.behaviour import behaviour_for
from agents.body import Body
from agents.division import Division, Key, group_of
from agents.docket import Docket, next_task, precedence
from agents.engagement import Engagement
from agents.part import Part
from agents.state import Event
from drivers.driver import Driver
from drivers.reading import Observation
from middleware.directory.presence import DONE, IDLE
from middleware.entangled.errors import EntangledError
from middleware.entangled.record import Record
from middleware.errors import SwarmError
from middleware.node import CAMERA, SwarmNode
from middleware.stop.halt import GOES_ON, NO_ROBOT, STANDS
from middleware.tasks.task import Member, Task, group_key, outcome_of, refusals, tasks_of

TICK = 0.05
REENGAGE = 0.5


class Agent(Service):
    """One device's agent; each tick has four steps: observe, decide, act, publish.

    The agent takes part in every open task that its robot can do.  One task has the robot; in the others the agent
    reports that it is not available.
    """

    def __init__(self, node: SwarmNode, driver: Driver, clock: IReactorTime, rng: random.Random) -> None:
        self._node = node
        self._clock = clock
        self._rng = rng
        self._body = Body(driver, clock, self._on_observation, self._on_missing)
        self._docket = Docket()
        self._checking: set[str] = set()
        self._parts: dict[str, Part] = {}
        self._divisions: dict[Key, Division] = {}
        self._holder: Part | None = None
        self._tick: IDelayedCall | None = None
        self._token = 0
        self._was_stopped = False
        node.halt.watch(self._apply_stop)

    @property
    def engagement(self) -> Engagement | None:
        """The engagement that has the robot, or None."""
        return None if self._holder is None else self._holder.engagement

    def startService(self) -> None:
        """Connect the robot, and follow the tasks once the node has joined."""
        super().startService()
        self._body.start()
        self._node.joined.addCallback(self._follow_tasks)
        self._tick = self._clock.callLater(TICK, self._on_tick)

    def stopService(self) -> Deferred[Any]:
        """Stop the robot, then release all leases; fires when the quorum members know."""
        super().stopService()
        self._body.stop()
        if self._tick is not None and self._tick.active():
            self._tick.cancel()
        releases: list[Deferred[Any]] = [self._leave(task_id) for task_id in list(self._parts)]
        return DeferredList([*releases, self._body.driver.disconnect()], consumeErrors=True)

    # -- observe ----------------------------------------------------------------------------------------------------

    def _on_observation(self, seen: Observation) -> None:
        if seen.frame is not None:
            # age: on the robot's clock until the frame was received, on this clock since then
            age = max(0.0, seen.t_robot - seen.frame.t_robot) + self._clock.seconds() - seen.t_host
            self._node.streams.offer(CAMERA, seen.frame.seq, seen.frame.data, age)
        if self._body.is_empty or self._body.is_off or not self._node.halt.is_known:
            return  # the robot could not act at once on this report, and others would rely on it
        for engagement in self._engagements_with_robot():
            if not engagement.is_over:
                engagement.look(seen, self._clock.seconds())

    def _on_missing(self, reason: str) -> None:
        self._say(f"has no robot: {reason}")

    # -- tasks ------------------------------------------------------------------------------------------------------

    def _follow_tasks(self, _: object) -> object:
        if self.running:
            self._node.halt.learn()
            self._node.watch_tasks(self._process_tasks)
        return _

    def _process_tasks(self, records: list[Record]) -> None:
        listed = tasks_of(records)
        self._docket.forget(listed, self._clock.seconds())
        for task_id, task in sorted(listed.items()):
            if refusals(self._body.driver.description.capabilities, task.requirements):
                continue
            if self._docket.is_new(task_id) and task_id not in self._checking:
                self._checking.add(task_id)
                self._check_outcome(task)
            elif task_id in self._docket.open:
                self._docket.add(task)
                if task_id in self._parts:
                    self._parts[task_id].engagement.renewed(task)

    def _check_outcome(self, task: Task) -> None:
        if self.running:
            known = self._node.entangled.get(group_key(task.task_id))
            known.addCallback(self._join_unless_over, task)
            known.addErrback(self._check_again, task)

    def _join_unless_over(self, records: list[Record], task: Task) -> None:
        """Join the task unless its outcome is already recorded."""
        self._checking.discard(task.task_id)
        if outcome_of(task, records) is not None:
            self._docket.bury(task.task_id, self._clock.seconds())
        elif self._docket.add(task):
            self._assign_robot()

    def _check_again(self, failure: Any, task: Task) -> None:
        """Check again later: no replica answered, so it is unknown whether the task is still open."""
        failure.trap(EntangledError)
        if self.running:
            self._clock.callLater(REENGAGE, self._check_outcome, task)

    def _assign_robot(self) -> None:
        """Join the open tasks, and give the robot to the most urgent one."""
        if not self.running:
            return
        followed = self._docket.followed()
        for task in followed:
            if task.task_id not in self._parts:
                self._engage(task)
        active = [part for part in self._parts.values() if not (part.engagement.is_over or part.engagement.is_paused)]
        holder = self._holder if self._holder in active else None
        current = None if holder is None else holder.engagement
        heads = self._most_urgent_parts(active)
        due_task = next_task(
            [head.engagement.task for head in heads],
            next((head.engagement.task for head, parts in heads.items() if holder in parts), None),
            current is None or current.may_be_put_aside,
        )
        parts = next((parts for head, parts in heads.items() if head.engagement.task is due_task), [])
        part = due(parts, holder) if parts else None
        if part is not self._holder:
            self._give_body(part)
        for each in active:
            each.engagement.lend_body(each in parts and each is not part, self._clock.seconds())

    def _most_urgent_parts(self, active: list[Part]) -> dict[Part, list[Part]]:
        """Return the most urgent part of each group with all parts of the group.

        A task without a group stands alone.
        """
        for task_id, part in self._parts.items():
            division = part.engagement.division
            if division is not None and part in active:
                part.engagement.join(division, self._clock.seconds())
            elif division is not None:
                division.leave(task_id)
        groups: dict[object, list[Part]] = {}
        for part in sorted(active, key=lambda part: precedence(part.engagement.task)):
            division = part.engagement.division
            groups.setdefault(part if division is None else division, []).append(part)
        return {parts[0]: parts for parts in groups.values()}

    def _engagements_with_robot(self) -> list[Engagement]:
        """Return the engagements that the robot is free for: the one that has it, and the others of its group."""
        return [p.engagement for p in list(self._parts.values()) if p is self._holder or p.engagement.claim.is_lent]

    def _engage(self, task: Task) -> None:
        try:
            behaviour = behaviour_for(task, self._rng, self._node.deployed, self._body.means)
            strategy = self._node.strategy(task.strategy)
        except SwarmError as error:
            self._docket.bury(task.task_id, self._clock.seconds())
            return self._say(str(error))
        stop = self._body.halt
        part = Part(task, self._node, behaviour, strategy, self._clock, self._token, self._publish_status, stop)
        self._parts[task.task_id] = part
        self._say(f"assigned: {task.title}")
        group = group_of(task)
        if group is not None:
            part.engagement.join(self._divisions.setdefault(group, Division(strategy)), self._clock.seconds())
        if self._holder is not None and (group is None or group != group_of(self._holder.engagement.task)):
            part.engagement.put_aside(f"busy with {self._holder.engagement.task.title}", self._clock.seconds())
        part.report()

    def _give_body(self, part: Part | None) -> None:
        """Take the robot from its current task and give it to the task of ``part``."""
        before, self._holder = self._holder, part
        group = None if part is None else part.engagement.division
        if before is not None and group is not None and before.engagement.division is group:
            before.engagement.lend_body(True, self._clock.seconds())
        elif before is not None and not before.engagement.is_over:
            self._body.driver.stop()
            why = f"busy with {part.engagement.task.title}" if part is not None else "paused"
            before.engagement.put_aside(why, self._clock.seconds())
        if part is None:
            return self._node.presence.change(task="", status=IDLE)
        engagement = part.engagement
        engagement.take_body(self._node.lessee(engagement.task, self._take_turn, self._token), self._token)
        self._node.presence.change(task=engagement.task.task_id, status=engagement.me.status)

    def _leave(self, task_id: str) -> Deferred[object]:
        part = self._parts.pop(task_id)
        division = part.engagement.division
        if division is not None:
            division.leave(task_id)
            left = [part.engagement.division for part in self._parts.values()]
            self._divisions = {key: each for key, each in self._divisions.items() if each in left}
        if part is self._holder:
            self._holder = None
        return part.leave(bool(self.running))

    # -- act --------------------------------------------------------------------------------------------------------

    def _on_tick(self) -> None:
        self._tick = self._clock.callLater(TICK, self._on_tick)
        self._take_turn()

    def _take_turn(self) -> None:
        if not self.running:
            return
        for part in list(self._parts.values()):
            if part.engagement.is_over:
                self._finish(part)
        self._assign_robot()
        for part in list(self._parts.values()):
            part.engagement.set_load(len(self._parts))
            part.caretaker.look()
            if part is not self._holder:
                part.engagement.step(self._clock.seconds())
        if self._node.halt.is_on:
            self._node.halt.refresh()
            return
        engagement = self.engagement
        if engagement is None:
            return
        has_body = self._body.answers
        if not has_body:
            for each in self._engagements_with_robot():
                each.lose_body()
        # The robot may have obeyed another agent before: it rejects older tokens.
        engagement.claim.raise_token(self._body.driver.token)
        deed = engagement.step(self._clock.seconds())
        self._token = max(self._token, engagement.claim.token)
        if deed is not None and has_body and not self._body.do(deed):
            engagement.on(Event.OUTRANKED, self._clock.seconds())

    def _apply_stop(self) -> str:
        """Stand still while the team is stopped, and return the robot's state for the stop's reply.

        The agent keeps its lease, so that no other agent takes over.
        """
        if not self.running:
            return NO_ROBOT
        halt = self._node.halt
        if halt.is_stopped != self._was_stopped:
            self._was_stopped = halt.is_stopped
            self._say(f"stopped by {halt.by}" if halt.is_stopped else f"released by {halt.released_by}")
        if not halt.is_on:
            return GOES_ON
        if not halt.is_known:
            halt.learn()  # no node has answered yet
        self._body.driver.stop()
        return STANDS if self._body.driver.state == "ready" else "does not reach its robot, which stops by itself"

    def _finish(self, part: Part) -> None:
        engagement = part.engagement
        had_body = part is self._holder
        if had_body:
            self._body.driver.stop()
        self._docket.bury(engagement.task.task_id, self._clock.seconds())
        self._leave(engagement.task.task_id)
        if had_body:
            by_me = engagement.result is not None and engagement.result.by == engagement.me.name
            self._node.presence.change(task="", status=DONE if by_me else IDLE)

    # -- publish ----------------------------------------------------------------------------------------------------

    def _publish_status(self, part: Part, member: Member) -> None:
        if part is self._holder and not part.engagement.is_over:
            # The end of the task sets the device's status instead.
            self._node.presence.change(status=member.status)

    def _say(self, text: str) -> None:
        self._node.presence.say(self._node.wall(), text)


def due(parts: list[Part], holder: Part | None) -> Part:
    """Return the part of a group that should have the robot: the assigned one, else one with an unknown cost.

    ``parts`` are sorted by urgency, at least one; ``holder`` has the robot now, for one of them or for another task.
    """
    own = holder if holder in parts else None
    if own is not None and (own.engagement.is_acting or not own.engagement.may_be_put_aside):
        return own
    assigned_part = next((part for part in parts if part.engagement.me.assigned == part.engagement.me.uuid), None)
    if assigned_part is not None:
        return assigned_part
    blind = [part for part in parts if part.engagement.me.cost is None]
    if own is not None and (own in blind or not blind):
        return own
    return (blind or parts)[0]
