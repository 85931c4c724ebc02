"""Agent: the mind of one device; it joins the tasks that its body can do and turns what is sensed into what is done."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

from twisted.application.service import Service
from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime
from twisted.internet.task import deferLater
from twisted.logger import Logger

from agents.behaviour import behaviour_for
from agents.engagement import Engagement
from drivers.driver import Driver
from drivers.errors import DriverError, LinkError, UsageError
from drivers.reading import Observation
from middleware.consensus.strategy import strategy_for
from middleware.entangled.errors import EntangledError
from middleware.entangled.record import Record
from middleware.errors import SwarmError
from middleware.group import Group
from middleware.node import CAMERA, SwarmNode
from middleware.presence import DONE, IDLE
from middleware.tasks import Member, Result, Task, group_key, outcome_of, refusals, task_of

TICK = 0.05
REENGAGE = 0.5
PATIENCE = 0.5
"""Seconds for which a robot may fall silent before its agent takes its report back."""


class Agent(Service):
    """One device's agent: one turn a tick, in the order observe, decide, act, publish."""

    _log = Logger()

    def __init__(self, node: SwarmNode, driver: Driver, clock: IReactorTime, rng: random.Random) -> None:
        self._node = node
        self._driver = driver
        self._clock = clock
        self._rng = rng
        self._open: dict[str, Task] = {}
        self._ended: set[str] = set()
        self._checking: set[str] = set()
        self._engagement: Engagement | None = None
        self._group: Group | None = None
        self._tick: IDelayedCall | None = None
        self._unsubscribe: Callable[[], None] | None = None
        self._token = 0
        self._is_awake = False
        self._answered_at = clock.seconds()

    def startService(self) -> None:
        """Connect the body, and follow the tasks once the node has joined."""
        super().startService()
        self._unsubscribe = self._driver.subscribe(self._seen)
        Deferred.fromCoroutine(self._wake()).addErrback(self._no_body)
        self._node.joined.addCallback(self._follow)
        self._tick = self._clock.callLater(TICK, self._turn)

    def stopService(self) -> Deferred[None]:
        """Stop the body first, then give back what is held."""
        super().stopService()
        self._driver.stop()
        if self._tick is not None and self._tick.active():
            self._tick.cancel()
        if self._unsubscribe is not None:
            self._unsubscribe()
        self._disengage()
        return self._driver.disconnect()

    async def _wake(self) -> None:
        """Have the body connected and its motors on; a link that goes away in between is tried again."""
        await self._driver.connect()
        while self.running and not self._is_awake:
            try:
                self._is_awake = await self._driver.enable()
            except LinkError as error:
                self._log.info("motors not on yet: {error}", error=error)
                await deferLater(self._clock, REENGAGE)

    def _no_body(self, failure: Any) -> None:
        failure.trap(DriverError)
        if self.running:
            reason = failure.getErrorMessage()
            self._log.warn("no robot: {reason}", reason=reason)
            self._node.presence.say(self._node.wall(), f"has no robot: {reason}")

    # -- observe ----------------------------------------------------------------------------------------------------

    def _seen(self, seen: Observation) -> None:
        if seen.frame is not None:
            self._node.streams.offer(CAMERA, seen.frame.seq, seen.frame.data)
        if self._engagement is not None and not self._engagement.is_over:
            self._engagement.look(seen)

    # -- tasks ------------------------------------------------------------------------------------------------------

    def _follow(self, _: object) -> object:
        if self.running:
            self._node.watch_tasks(self._tasks)
        return _

    def _tasks(self, records: list[Record]) -> None:
        for task in sorted(filter(None, map(task_of, records)), key=lambda t: (t.created, t.task_id)):
            new = task.task_id not in self._open and task.task_id not in self._ended | self._checking
            if new and not refusals(self._driver.description.capabilities, task.requirements):
                self._checking.add(task.task_id)
                self._check(task)

    def _check(self, task: Task) -> None:
        if self.running:
            known = self._node.entangled.get(group_key(task.task_id))
            known.addCallback(self._checked, task)
            known.addErrback(self._unchecked, task)

    def _checked(self, records: list[Record], task: Task) -> None:
        """A task heard of: it may be an old one that is done."""
        self._checking.discard(task.task_id)
        if outcome_of(records) is not None:
            self._ended.add(task.task_id)
        else:
            self._open[task.task_id] = task
            self._engage_next()

    def _unchecked(self, failure: Any, task: Task) -> None:
        """Nobody could tell whether the task is still open: ask again in a while."""
        failure.trap(EntangledError)
        if self.running:
            self._clock.callLater(REENGAGE, self._check, task)

    def _engage_next(self) -> None:
        busy = self._engagement is not None and not self._engagement.is_over
        if busy or not self._open or not self.running:
            return
        self._disengage()
        task = min(self._open.values(), key=lambda t: (t.created, t.task_id))
        try:
            behaviour = behaviour_for(task, self._rng, self._node.deployed)
            strategy = strategy_for(task.strategy, deployed=self._node.deployed)
        except SwarmError as error:
            self._ended.add(task.task_id)
            del self._open[task.task_id]
            self._node.presence.say(self._node.wall(), str(error))
            return self._engage_next()
        me = Member(self._node.uuid, self._node.presence.device.name, IDLE)
        engagement = Engagement(
            task,
            me,
            behaviour,
            strategy,
            self._clock,
            self._token,
            self._tell,
            self._conclude,
            self._say,
            self._driver.stop,
        )
        engagement.justify = self._node.justify
        engagement.lessee = self._node.lessee(task, self._turn_now, self._token)
        self._engagement = engagement
        self._group = self._node.group(task.task_id, engagement.heard)
        self._group.report(engagement.me)
        self._node.presence.change(task=task.task_id, status=engagement.me.status)
        self._say(f"assigned: {task.title}")

    def _disengage(self) -> None:
        engagement, self._engagement = self._engagement, None
        group, self._group = self._group, None
        if engagement is not None:
            engagement.abandon()
        if group is not None:
            group.leave()
            if self.running:
                group.withdraw()

    # -- act --------------------------------------------------------------------------------------------------------

    def _turn(self) -> None:
        self._tick = self._clock.callLater(TICK, self._turn)
        self._turn_now()

    def _turn_now(self) -> None:
        engagement = self._engagement
        if engagement is None or not self.running:
            return
        if engagement.is_over:
            return self._finished(engagement)
        has_body = self._has_body
        if not has_body:
            engagement.lose_body()
        deed = engagement.step()
        self._token = max(self._token, engagement.token)
        if deed is None or not has_body or self._driver.state != "ready":
            return
        try:
            self._driver.act(deed.action, deed.permit)
        except UsageError as error:
            self._driver.stop()
            self._log.debug("the body refused: {error}", error=error)
        except DriverError as error:
            self._log.info("the body does not answer: {error}", error=error)

    @property
    def _has_body(self) -> bool:
        """Whether the robot answers with its motors on, or did so a moment ago."""
        seen = self._driver.observe()
        has_motors = seen is None or seen.values.get("estop.engaged") is not True
        now = self._clock.seconds()
        if self._is_awake and has_motors and self._driver.state == "ready":
            self._answered_at = now
        return self._is_awake and has_motors and now - self._answered_at <= PATIENCE

    def _finished(self, engagement: Engagement) -> None:
        task_id = engagement.task.task_id
        if task_id in self._ended:
            return
        self._driver.stop()
        self._ended.add(task_id)
        self._open.pop(task_id, None)
        engagement.abandon()
        by_me = engagement.result is not None and engagement.result.by == engagement.me.name
        self._node.presence.change(task="", status=DONE if by_me else IDLE)
        self._engage_next()

    # -- publish ----------------------------------------------------------------------------------------------------

    def _tell(self, member: Member) -> None:
        engagement, group = self._engagement, self._group
        if engagement is not None and group is not None:
            group.report(member)
            if not engagement.is_over:
                # What the device is after the task, its end says.
                self._node.presence.change(status=member.status)

    def _conclude(self, result: Result) -> None:
        engagement, group = self._engagement, self._group
        if engagement is None or group is None:
            return
        concluded = group.conclude(result)
        concluded.addErrback(self._not_concluded, engagement.task.task_id, result)

    def _not_concluded(self, failure: Any, task_id: str, result: Result) -> None:
        """No majority could be told: try again for as long as the task is ours to conclude."""
        failure.trap(EntangledError)
        if self.running and self._engagement is not None and self._engagement.task.task_id == task_id:
            self._clock.callLater(REENGAGE, self._conclude, result)

    def _say(self, text: str) -> None:
        self._node.presence.say(self._node.wall(), text)
