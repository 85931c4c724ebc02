"""One agent's engagement in one task, connected to the task's group: its reports are sent through it.

The caretaker replaces lost members of the task's quorum.  This is the duty of the acting agent or, while no agent acts,
of the first present agent (consensus rules 1 and 2).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from agents.behaviour import Behaviour
from agents.engagement import Engagement
from agents.state import Event
from middleware.consensus.bidding.panel import panel_of
from middleware.consensus.lease.council import Council, Superseded
from middleware.consensus.strategy import ConsensusAlgorithm
from middleware.consensus.verdict import Verdict
from middleware.directory.presence import IDLE
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError
from middleware.entangled.record import Record
from middleware.node import SwarmNode
from middleware.tasks.order import order_of
from middleware.tasks.task import Member, Result, Task, council_of, group_key

AGAIN = 0.5
"""Seconds until an outcome is sent again after no majority could be reached."""

VISIT_S = 5.0
"""Seconds between two checks; a quorum without lease requests is probed at this interval."""
LOOK_AGAIN_S = 10.0
"""Seconds until a successor is looked for again after none was found."""


class Caretaker:
    """Maintains the quorum of the task of ``engagement`` on behalf of ``node``."""

    def __init__(self, engagement: Engagement, node: SwarmNode, clock: IReactorTime) -> None:
        self._engagement = engagement
        self._node = node
        self._clock = clock
        self._council: Council | None = None
        self._next_check_at = clock.seconds() + VISIT_S
        self._next_search_at = 0.0

    def look(self) -> None:
        """Check the quorum and replace lost members, if that is this agent's duty."""
        engagement, now = self._engagement, self._clock.seconds()
        if now < self._next_check_at or not engagement.keeps_council(now):
            return
        self._next_check_at = now + VISIT_S
        lessee = engagement.lessee if engagement.is_acting else None
        council = self._probed_council() if lessee is None else lessee.council
        if now >= self._next_search_at and self._node.councils.has_vacancy(engagement.task, council):
            self._next_search_at = now + LOOK_AGAIN_S
            following = Deferred.fromCoroutine(self._node.councils.successors(engagement.task, council))
            following.addCallback(self._hand_over_council, council).addErrback(_ignore_unreachable)

    def _probed_council(self) -> Council:
        """Probe the quorum, which gets no lease requests at present."""
        task = self._engagement.task
        if self._council is None:
            self._council = self._node.councils.of(task)
        self._council.learn(task.charter)
        self._council.visit()
        return self._council

    def _hand_over_council(self, members: tuple[Contact, ...] | None, council: Council) -> object:
        if members is not None and council is self._council:
            return council.change(members)
        if members is not None:
            self._engagement.hand_council(members)
        return None


def _ignore_unreachable(failure: Any) -> None:
    """Ignore that too few members answer or that the lease is claimed: the caretaker tries again."""
    failure.trap(EntangledError)


class Part:
    """The agent of ``node`` at ``task``; ``told`` is called with each report that is sent."""

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
        self.halt = halt
        self.reached = node.reached
        self._node = node
        self._clock = clock
        self._told = told
        self._close: Callable[[], None] = getattr(behaviour, "close", lambda: None)
        me = Member(node.uuid, node.presence.device.name, IDLE)
        age = max(0.0, node.wall() - task.created)
        self._panel = panel_of(node.uuid, group_key(task.task_id))
        now = clock.seconds()
        self.engagement = Engagement(task, me, behaviour, strategy, self, self._panel, token, now, age)
        self.caretaker = Caretaker(self.engagement, node, clock)
        self._group = node.group(task, self._on_reports, self._on_orders, self._panel)

    def report(self) -> None:
        """Send the agent's report."""
        self._group.report(self.engagement.me)

    def leave(self, is_running: bool) -> Deferred[object]:
        """Release the lease and leave the group; a node that continues to run also withdraws its report.

        Fires when the quorum members know.
        """
        self.is_left = True
        released = self.engagement.abandon(self._clock.seconds())
        self._close()
        self._group.leave()
        if is_running:
            self._group.withdraw()
        return released

    def _on_reports(self, members: list[Member], outcome: Result | None) -> None:
        self.engagement.heard(members, outcome, self._clock.seconds())

    def _on_orders(self, records: list[Record]) -> None:
        self.engagement.ordered(order_of(records))
        task = council_of(self.engagement.task, records)
        if task is not self.engagement.task:
            self.engagement.renewed(task)

    def tell(self, member: Member) -> None:
        """Publish this agent's report."""
        self._group.report(member)
        self._told(self, member)

    def justify(self, verdict: Verdict) -> None:
        """Publish the record of a decision, if the agent's report is visible to the others."""
        if self._panel.counts(self._clock.seconds()):
            self._node.justify(verdict)

    def conclude(self, result: Result) -> None:
        """Record the outcome, while this agent may record it."""
        lessee = self.engagement.lessee
        if self.is_left or lessee is None:
            return
        result = replace(result, token=max(result.token, lessee.token))
        proved = lessee.end(result.token)
        proved.addCallback(lambda proof: self._group.conclude(result, proof))
        proved.addErrback(self._retry_conclude, result)

    def _retry_conclude(self, failure: Any, result: Result) -> None:
        """Try again while this agent may record the outcome: no majority could be reached."""
        failure.trap(EntangledError)
        if failure.check(Superseded) is not None:
            self.engagement.on(Event.REOPENED, self._clock.seconds())
        elif not self.is_left and not self.engagement.is_over:
            self._clock.callLater(AGAIN, self.conclude, result)

    def say(self, text: str) -> None:
        """Write a line to the device's log on the page."""
        self._node.presence.say(self._node.wall(), text)
