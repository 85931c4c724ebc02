"""Part: one agent's engagement in one task, with its place in the group of the task; reports go out through it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from agents.behaviour import Behaviour
from agents.caretaker import Caretaker
from agents.engagement import Engagement
from middleware.consensus.bidding.panel import panel_of
from middleware.consensus.lease.council import Superseded
from middleware.consensus.strategy import ConsensusAlgorithm
from middleware.consensus.verdict import Verdict
from middleware.directory.presence import IDLE
from middleware.entangled.errors import EntangledError
from middleware.entangled.record import Record
from middleware.node import SwarmNode
from middleware.tasks.order import order_of
from middleware.tasks.task import Member, Result, Task, council_of, group_key

AGAIN = 0.5
"""Seconds until an outcome that no majority could be told is told again."""


class Part:
    """The agent of ``node`` at ``task``; ``told`` is called with each report that goes out."""

    def __init__(
        self,
        task: Task,
        node: SwarmNode,
        behaviour: Behaviour,
        strategy: ConsensusAlgorithm,
        clock: IReactorTime,
        token: int,
        told: Callable[[Part, Member], None],
        halt: Callable[[], float],
    ) -> None:
        self.is_left = False
        self._node = node
        self._clock = clock
        self._told = told
        self._close: Callable[[], None] = getattr(behaviour, "close", lambda: None)
        me = Member(node.uuid, node.presence.device.name, IDLE)
        age = max(0.0, node.wall() - task.created)
        self.engagement = Engagement(
            task, me, behaviour, strategy, clock, token, self._tell, self._conclude, self._say, halt, age
        )
        self._panel = panel_of(node.uuid, group_key(task.task_id))
        self.engagement.seat(self._panel)
        self.engagement.justify = self._justify
        self.engagement.reached = node.reached
        self.caretaker = Caretaker(self.engagement, node, clock)
        self._group = node.group(task, self.engagement.heard, self._ordered, self._panel)

    def report(self) -> None:
        """Tell the others how things stand."""
        self._group.report(self.engagement.me)

    def leave(self, is_running: bool) -> Deferred[object]:
        """Give back what is held and hear no more of it; who goes on running takes its report back.

        Fires when those who lend it know.
        """
        self.is_left = True
        told = self.engagement.abandon()
        self._close()
        self._group.leave()
        if is_running:
            self._group.withdraw()
        return told

    def _ordered(self, records: list[Record]) -> None:
        self.engagement.ordered(order_of(records))
        task = council_of(self.engagement.task, records)
        if task is not self.engagement.task:
            self.engagement.renewed(task)

    def _tell(self, member: Member) -> None:
        self._group.report(member)
        self._told(self, member)

    def _justify(self, verdict: Verdict) -> None:
        if self._panel.counts(self._clock.seconds()):
            self._node.justify(verdict)

    def _conclude(self, result: Result) -> None:
        lessee = self.engagement.lessee
        if self.is_left or lessee is None:
            return
        result = replace(result, token=max(result.token, lessee.token))
        proved = lessee.end(result.token)
        proved.addCallback(lambda proof: self._group.conclude(result, proof))
        proved.addErrback(self._not_concluded, result)

    def _not_concluded(self, failure: Any, result: Result) -> None:
        """No majority could be told: try again for as long as the task is this agent's to conclude."""
        failure.trap(EntangledError)
        if failure.check(Superseded) is not None:
            return self.engagement.reopen()
        if not self.is_left and not self.engagement.is_over:
            self._clock.callLater(AGAIN, self._conclude, result)

    def _say(self, text: str) -> None:
        self._node.presence.say(self._node.wall(), text)
