"""One agent's engagement in one task, connected to the task's group, through which the reports are sent.

The council maintainer replaces lost members of the task's quorum. This is the duty of the acting agent or, while no
agent acts, of the present agent with the lowest uuid (consensus rules 1 and 2).
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
from middleware.consensus.bidding.reporters import make_reporters
from middleware.consensus.decision_record import DecisionRecord
from middleware.consensus.lease.lease_proposer import LeaseProposer, Superseded
from middleware.consensus.strategy import ConsensusAlgorithm
from middleware.directory.presence import IDLE
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError
from middleware.entangled.record import Record
from middleware.node import SwarmNode
from middleware.tasks.order import find_newest_order
from middleware.tasks.task import Member, Result, Task, group_key, with_newest_council

OUTCOME_RETRY_S = 0.5
"""Seconds until an outcome is sent again if no majority could be reached."""

COUNCIL_CHECK_S = 5.0
"""Seconds between two checks; a quorum that receives no lease requests is probed at this interval."""
SUCCESSOR_RETRY_S = 10.0
"""Seconds until the next search for a replacement member if no node was found."""


class CouncilMaintainer:
    """Maintains the quorum of the task of ``engagement`` on behalf of ``node``."""

    def __init__(self, engagement: Engagement, node: SwarmNode, clock: IReactorTime) -> None:
        self._engagement = engagement
        self._node = node
        self._clock = clock
        self._council: LeaseProposer | None = None
        self._next_check_at = clock.seconds() + COUNCIL_CHECK_S
        self._next_search_at = 0.0

    def check(self) -> None:
        """Check the quorum and replace lost members, if that is this agent's duty."""
        engagement, now = self._engagement, self._clock.seconds()
        if now < self._next_check_at or not engagement.is_council_maintainer(now):
            return
        self._next_check_at = now + COUNCIL_CHECK_S
        lease_client = engagement.lease_client if engagement.is_acting else None
        council = self._probe_council() if lease_client is None else lease_client.proposer
        if now >= self._next_search_at and self._node.council_manager.has_vacancy(engagement.task, council):
            self._next_search_at = now + SUCCESSOR_RETRY_S
            following = Deferred.fromCoroutine(self._node.council_manager.find_successors(engagement.task, council))
            following.addCallback(self._hand_over_council, council).addErrback(_ignore_unreachable)

    def _probe_council(self) -> LeaseProposer:
        """Probe the members of the quorum, which receive no lease requests at present."""
        task = self._engagement.task
        if self._council is None:
            self._council = self._node.council_manager.make_proposer(task)
        self._council.learn_charter(task.charter)
        self._council.ping_members()
        return self._council

    def _hand_over_council(self, members: tuple[Contact, ...] | None, council: LeaseProposer) -> object:
        if members is not None and council is self._council:
            return council.change_members(members)
        if members is not None:
            self._engagement.schedule_council_change(members)
        return None


def _ignore_unreachable(failure: Any) -> None:
    """Ignore that too few members answered, or that the lease is claimed; the council maintainer tries again."""
    failure.trap(EntangledError)


class Participation:
    """The agent of ``node`` at ``task``; ``on_report_sent`` is called with each report that is sent."""

    def __init__(
        self,
        task: Task,
        node: SwarmNode,
        behaviour: Behaviour,
        strategy: ConsensusAlgorithm,
        clock: IReactorTime,
        token: int,
        on_report_sent: Callable[[Participation, Member], None],
        stop_robot: Callable[[], float],
    ) -> None:
        self.has_left = False
        self.stop_robot = stop_robot
        self.find_contacts = node.find_contacts
        self._node = node
        self._clock = clock
        self._on_report_sent = on_report_sent
        self._close_behaviour: Callable[[], None] = getattr(behaviour, "close", lambda: None)
        me = Member(node.uuid, node.presence.device.name, IDLE)
        age = max(0.0, node.wall() - task.created)
        self._panel = make_reporters(node.uuid, group_key(task.task_id))
        now = clock.seconds()
        self.engagement = Engagement(task, me, behaviour, strategy, self, self._panel, token, now, age)
        self.council_maintainer = CouncilMaintainer(self.engagement, node, clock)
        self._group = node.join_group(task, self._on_reports, self._on_orders, self._panel)

    def report(self) -> None:
        """Send the agent's report."""
        self._group.report(self.engagement.me)

    def leave(self, is_running: bool) -> Deferred[object]:
        """Release the lease and leave the group; a node that continues to run also withdraws its report.

        Fires when the quorum members have been notified.
        """
        self.has_left = True
        released = self.engagement.leave(self._clock.seconds())
        self._close_behaviour()
        self._group.leave()
        if is_running:
            self._group.withdraw()
        return released

    def _on_reports(self, members: list[Member], outcome: Result | None) -> None:
        self.engagement.process_reports(members, outcome, self._clock.seconds())

    def _on_orders(self, records: list[Record]) -> None:
        self.engagement.process_order(find_newest_order(records))
        task = with_newest_council(self.engagement.task, records)
        if task is not self.engagement.task:
            self.engagement.update_task(task)

    def publish_report(self, member: Member) -> None:
        """Publish this agent's report."""
        self._group.report(member)
        self._on_report_sent(self, member)

    def publish_decision_record(self, record: DecisionRecord) -> None:
        """Publish the record of a decision, if the agent's report is visible to the others."""
        if self._panel.is_known(self._clock.seconds()):
            self._node.publish_decision_record(record)

    def record_outcome(self, result: Result) -> None:
        """Record the outcome of the task, as long as this agent is permitted to record it."""
        lease_client = self.engagement.lease_client
        if self.has_left or lease_client is None:
            return
        result = replace(result, token=max(result.token, lease_client.token))
        proved = lease_client.close_task(result.token)
        proved.addCallback(lambda proof: self._group.conclude(result, proof))
        proved.addErrback(self._retry_record_outcome, result)

    def _retry_record_outcome(self, failure: Any, result: Result) -> None:
        """Try again because no majority could be reached, as long as this agent is permitted to record the outcome."""
        failure.trap(EntangledError)
        if failure.check(Superseded) is not None:
            self.engagement.apply_event(Event.REOPENED, self._clock.seconds())
        elif not self.has_left and not self.engagement.is_over:
            self._clock.callLater(OUTCOME_RETRY_S, self.record_outcome, result)

    def log_event(self, text: str) -> None:
        """Write a line to the device's log, which the page displays."""
        self._node.presence.add_message(self._node.wall(), text)
