"""The agent of one device: joins the tasks that its robot can do and turns observations into actions."""

from __future__ import annotations

import random
from typing import Any

from twisted.application.service import Service
from twisted.internet.defer import Deferred, DeferredList
from twisted.internet.interfaces import IDelayedCall, IReactorTime

from agents.behaviour import create_behaviour
from agents.engagement import Engagement
from agents.participation import Participation
from agents.robot import AgentRobot
from agents.state import Event
from agents.task_group import GroupKey, TaskGroup, get_group_key
from agents.task_queue import TaskQueue, select_task, urgency_key
from drivers.driver import Driver
from drivers.reading import Observation
from middleware.directory.presence import DONE, IDLE
from middleware.entangled.errors import EntangledError
from middleware.entangled.record import Record
from middleware.errors import SwarmError
from middleware.node import CAMERA, SwarmNode
from middleware.stop.stop_state import CONTINUES, NO_ROBOT, STANDS_STILL
from middleware.tasks.task import Member, Task, find_outcome, find_unmet_requirements, group_key, parse_tasks

TICK_S = 0.05
OUTCOME_RETRY_S = 0.5


class Agent(Service):
    """One device's agent; each tick has four steps: observe, decide, act, publish.

    The agent takes part in every open task that its robot can do. The robot is assigned to one of these tasks; in all
    other tasks the agent reports that it is not available.
    """

    def __init__(self, node: SwarmNode, driver: Driver, clock: IReactorTime, rng: random.Random) -> None:
        self._node = node
        self._clock = clock
        self._rng = rng
        self._robot = AgentRobot(driver, clock, self._on_observation, self._on_missing)
        self._task_queue = TaskQueue()
        self._checking_ids: set[str] = set()
        self._participations: dict[str, Participation] = {}
        self._task_groups: dict[GroupKey, TaskGroup] = {}
        self._robot_user: Participation | None = None
        self._tick_call: IDelayedCall | None = None
        self._token = 0
        self._was_stopped = False
        node.stop_state.subscribe(self._apply_stop)

    @property
    def engagement(self) -> Engagement | None:
        """The engagement to which the robot is assigned, or None."""
        return None if self._robot_user is None else self._robot_user.engagement

    def startService(self) -> None:
        """Connect the robot, and follow the tasks once the node has joined."""
        super().startService()
        self._robot.start()
        self._node.joined.addCallback(self._follow_tasks)
        self._tick_call = self._clock.callLater(TICK_S, self._on_tick)

    def stopService(self) -> Deferred[Any]:
        """Stop the robot, then release all leases; fires when the quorum members know."""
        super().stopService()
        self._robot.stop()
        if self._tick_call is not None and self._tick_call.active():
            self._tick_call.cancel()
        releases: list[Deferred[Any]] = [self._leave(task_id) for task_id in list(self._participations)]
        return DeferredList([*releases, self._robot.driver.disconnect()], consumeErrors=True)

    # -- observe ----------------------------------------------------------------------------------------------------

    def _on_observation(self, seen: Observation) -> None:
        if seen.frame is not None:
            # The age is measured on the robot's clock until the frame was received, and on this clock since then.
            age = max(0.0, seen.t_robot - seen.frame.t_robot) + self._clock.seconds() - seen.t_host
            self._node.streams.publish(CAMERA, seen.frame.seq, seen.frame.data, age)
        if self._robot.is_battery_empty or self._robot.is_estop_engaged or not self._node.stop_state.is_known:
            return  # no reports: the robot cannot act now
        for engagement in self._engagements_with_robot():
            if not engagement.is_over:
                engagement.look(seen, self._clock.seconds())

    def _on_missing(self, reason: str) -> None:
        self._log_event(f"has no robot: {reason}")

    # -- tasks ------------------------------------------------------------------------------------------------------

    def _follow_tasks(self, _: object) -> object:
        if self.running:
            self._node.stop_state.request_stops()
            self._node.watch_tasks(self._process_tasks)
        return _

    def _process_tasks(self, records: list[Record]) -> None:
        listed = parse_tasks(records)
        self._task_queue.expire_tombstones(listed, self._clock.seconds())
        for task_id, task in sorted(listed.items()):
            if find_unmet_requirements(self._robot.driver.description.capabilities, task.requirements):
                continue
            if self._task_queue.is_new(task_id) and task_id not in self._checking_ids:
                self._checking_ids.add(task_id)
                self._check_outcome(task)
            elif task_id in self._task_queue.open_ids:
                self._task_queue.add(task)
                if task_id in self._participations:
                    self._participations[task_id].engagement.update_task(task)

    def _check_outcome(self, task: Task) -> None:
        if self.running:
            known = self._node.entangled.get(group_key(task.task_id))
            known.addCallback(self._join_unless_over, task)
            known.addErrback(self._check_again, task)

    def _join_unless_over(self, records: list[Record], task: Task) -> None:
        """Join the task unless its outcome is already recorded."""
        self._checking_ids.discard(task.task_id)
        if find_outcome(task, records) is not None:
            self._task_queue.mark_over(task.task_id, self._clock.seconds())
        elif self._task_queue.add(task):
            self._assign_robot()

    def _check_again(self, failure: Any, task: Task) -> None:
        """Check again later: no replica answered, so it is unknown whether the task is still open."""
        failure.trap(EntangledError)
        if self.running:
            self._clock.callLater(OUTCOME_RETRY_S, self._check_outcome, task)

    def _assign_robot(self) -> None:
        """Join the open tasks, and give the robot to the most urgent one."""
        if not self.running:
            return
        followed = self._task_queue.list_followed()
        for task in followed:
            if task.task_id not in self._participations:
                self._join_task(task)
        active = [
            part for part in self._participations.values() if not (part.engagement.is_over or part.engagement.is_paused)
        ]
        holder = self._robot_user if self._robot_user in active else None
        current = None if holder is None else holder.engagement
        participations_by_head = self._group_by_urgency(active)
        due_task = select_task(
            [head.engagement.task for head in participations_by_head],
            next((head.engagement.task for head, parts in participations_by_head.items() if holder in parts), None),
            current is None or current.can_yield_robot,
        )
        parts = next((parts for head, parts in participations_by_head.items() if head.engagement.task is due_task), [])
        part = select_participation(parts, holder) if parts else None
        if part is not self._robot_user:
            self._give_robot(part)
        for each in active:
            each.engagement.set_robot_lent(each in parts and each is not part, self._clock.seconds())

    def _group_by_urgency(self, active: list[Participation]) -> dict[Participation, list[Participation]]:
        """Return the most urgent participation of each group, together with all participations in the group.

        A task without a group forms a group of its own.
        """
        for task_id, part in self._participations.items():
            task_group = part.engagement.task_group
            if task_group is not None and part in active:
                part.engagement.join_group(task_group, self._clock.seconds())
            elif task_group is not None:
                task_group.leave(task_id)
        groups: dict[object, list[Participation]] = {}
        for part in sorted(active, key=lambda part: urgency_key(part.engagement.task)):
            task_group = part.engagement.task_group
            groups.setdefault(part if task_group is None else task_group, []).append(part)
        return {parts[0]: parts for parts in groups.values()}

    def _engagements_with_robot(self) -> list[Engagement]:
        """Return the engagements for which the robot is available: the current one, and all others of its group."""
        return [
            p.engagement
            for p in list(self._participations.values())
            if p is self._robot_user or p.engagement.task_lease.is_lent
        ]

    def _join_task(self, task: Task) -> None:
        try:
            behaviour = create_behaviour(task, self._rng, self._node.deployed, self._robot.motion)
            strategy = self._node.get_strategy(task.strategy)
        except SwarmError as error:
            self._task_queue.mark_over(task.task_id, self._clock.seconds())
            return self._log_event(str(error))
        stop = self._robot.halt
        part = Participation(
            task, self._node, behaviour, strategy, self._clock, self._token, self._publish_status, stop
        )
        self._participations[task.task_id] = part
        self._log_event(f"assigned: {task.title}")
        group = get_group_key(task)
        if group is not None:
            part.engagement.join_group(self._task_groups.setdefault(group, TaskGroup(strategy)), self._clock.seconds())
        if self._robot_user is not None and (group is None or group != get_group_key(self._robot_user.engagement.task)):
            part.engagement.yield_robot(f"busy with {self._robot_user.engagement.task.title}", self._clock.seconds())
        part.report()

    def _give_robot(self, part: Participation | None) -> None:
        """Take the robot from its current task and give it to the task of ``part``."""
        before, self._robot_user = self._robot_user, part
        group = None if part is None else part.engagement.task_group
        if before is not None and group is not None and before.engagement.task_group is group:
            before.engagement.set_robot_lent(True, self._clock.seconds())
        elif before is not None and not before.engagement.is_over:
            self._robot.driver.stop()
            why = f"busy with {part.engagement.task.title}" if part is not None else "paused"
            before.engagement.yield_robot(why, self._clock.seconds())
        if part is None:
            return self._node.presence.change(task="", status=IDLE)
        engagement = part.engagement
        engagement.take_robot(self._node.make_lease_client(engagement.task, self._run_turn, self._token), self._token)
        self._node.presence.change(task=engagement.task.task_id, status=engagement.me.status)

    def _leave(self, task_id: str) -> Deferred[object]:
        part = self._participations.pop(task_id)
        task_group = part.engagement.task_group
        if task_group is not None:
            task_group.leave(task_id)
            left = [part.engagement.task_group for part in self._participations.values()]
            self._task_groups = {key: each for key, each in self._task_groups.items() if each in left}
        if part is self._robot_user:
            self._robot_user = None
        return part.leave(bool(self.running))

    # -- act --------------------------------------------------------------------------------------------------------

    def _on_tick(self) -> None:
        self._tick_call = self._clock.callLater(TICK_S, self._on_tick)
        self._run_turn()

    def _run_turn(self) -> None:
        if not self.running:
            return
        for part in list(self._participations.values()):
            if part.engagement.is_over:
                self._finish(part)
        self._assign_robot()
        for part in list(self._participations.values()):
            part.engagement.set_load(len(self._participations))
            part.council_maintainer.check()
            if part is not self._robot_user:
                part.engagement.step(self._clock.seconds())
        if self._node.stop_state.is_motion_forbidden:
            self._node.stop_state.recheck()
            return
        engagement = self.engagement
        if engagement is None:
            return
        has_robot = self._robot.is_responding
        if not has_robot:
            for each in self._engagements_with_robot():
                each.on_robot_lost()
        # The robot may have obeyed another agent earlier: it then rejects older tokens.
        engagement.task_lease.raise_token(self._robot.driver.token)
        command = engagement.step(self._clock.seconds())
        self._token = max(self._token, engagement.task_lease.token)
        if command is not None and has_robot and not self._robot.perform(command):
            engagement.apply_event(Event.OUTRANKED, self._clock.seconds())

    def _apply_stop(self) -> str:
        """Keep the robot at rest while the team is stopped, and return the robot's state, which the node reports.

        The agent keeps its lease, so that no other agent takes over.
        """
        if not self.running:
            return NO_ROBOT
        stop_state = self._node.stop_state
        if stop_state.is_stopped != self._was_stopped:
            self._was_stopped = stop_state.is_stopped
            self._log_event(
                f"stopped by {stop_state.operators}"
                if stop_state.is_stopped
                else f"released by {stop_state.released_by}"
            )
        if not stop_state.is_motion_forbidden:
            return CONTINUES
        if not stop_state.is_known:
            stop_state.request_stops()  # no node has reported its stops yet
        self._robot.driver.stop()
        return (
            STANDS_STILL if self._robot.driver.state == "ready" else "does not reach its robot, which stops by itself"
        )

    def _finish(self, part: Participation) -> None:
        engagement = part.engagement
        had_robot = part is self._robot_user
        if had_robot:
            self._robot.driver.stop()
        self._task_queue.mark_over(engagement.task.task_id, self._clock.seconds())
        self._leave(engagement.task.task_id)
        if had_robot:
            by_me = engagement.result is not None and engagement.result.by == engagement.me.name
            self._node.presence.change(task="", status=DONE if by_me else IDLE)

    # -- publish ----------------------------------------------------------------------------------------------------

    def _publish_status(self, part: Participation, member: Member) -> None:
        if part is self._robot_user and not part.engagement.is_over:
            # When the task ends, the device's status is set elsewhere.
            self._node.presence.change(status=member.status)

    def _log_event(self, text: str) -> None:
        self._node.presence.add_message(self._node.wall(), text)


def select_participation(parts: list[Participation], holder: Participation | None) -> Participation:
    """Return the participation that should get the robot: the one assigned to it, else one with unknown cost.

    ``parts`` are the participations of a group: at least one, sorted by urgency. ``holder`` is the participation that
    has the robot now; it may be outside of ``parts``.
    """
    own = holder if holder in parts else None
    if own is not None and (own.engagement.is_acting or not own.engagement.can_yield_robot):
        return own
    assigned_part = next((part for part in parts if part.engagement.me.assigned == part.engagement.me.uuid), None)
    if assigned_part is not None:
        return assigned_part
    blind = [part for part in parts if part.engagement.me.cost is None]
    if own is not None and (own in blind or not blind):
        return own
    return (blind or parts)[0]
