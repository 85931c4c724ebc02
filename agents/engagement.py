"""One agent's part in one task, from assignment to end (Algorithm 4.5, revised).

Selection and commitment are separate: ``decide`` selects the agent that should act, and the lease gives this agent the
right to act. An agent executes a task only under a valid lease. When the decision or the lease changes, the agent
first stops the robot, then releases the lease. Each step determines one event; the table in ``agents.state`` lists the
effects of the event, and this module performs them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from twisted.internet.defer import Deferred

from agents.behaviour import Behaviour
from agents.decider import Decider
from agents.decision import Decision
from agents.execution import Execution
from agents.formation import Formation
from agents.motion import STAND
from agents.report import ReportBuilder
from agents.state import Effect, Event, State, StateMachine
from agents.task_group import TaskGroup
from agents.task_lease import STANDBYS, TaskLease
from drivers.driver import Permit
from drivers.reading import Action, Observation
from middleware.consensus.bidding.reporters import Reporters
from middleware.consensus.decision_record import DecisionRecord
from middleware.consensus.lease.lease_client import Lease, LeaseClient
from middleware.consensus.strategy import ConsensusAlgorithm, find_read_fields
from middleware.directory.presence import EXECUTING
from middleware.entangled.contact import Contact
from middleware.tasks.order import PAUSE, Order
from middleware.tasks.task import COMPLETED, FAILED, Member, Result, Task

SEARCH_TTL_S = 0.5
"""Seconds for which a motion without a lease (looking around) is permitted at a time."""
SETTLED_STATES = State.RELEASING, State.DONE
NO_DECISION = Decision(None, "", "")


@dataclass(frozen=True)
class RobotCommand:
    """An action for the robot and its permit."""

    action: Action
    permit: Permit


class EngagementOutputs(Protocol):
    """The outputs of an engagement."""

    def publish_report(self, member: Member) -> None:
        """Publish this agent's report."""

    def record_outcome(self, result: Result) -> None:
        """Record the outcome."""

    def log_event(self, text: str) -> None:
        """Write a line to the device's log, which the page displays."""

    def stop_robot(self) -> float:
        """Stop the robot; return the seconds for which it may still move if it does not respond."""

    def publish_decision_record(self, record: DecisionRecord) -> None:
        """Publish the record of a decision."""

    def find_contacts(self, uuids: Sequence[str]) -> Sequence[Contact]:
        """Return the known contacts of the agents with these uuids."""


class Engagement:
    """One agent's part in one task.

    ``age`` is the age of the task in seconds at ``now``, the time at which the agent joins the task; ``token`` is the
    highest fencing token that the robot has obeyed. Until the robot is assigned to this task, or to another task of
    its group, the agent only receives reports.
    """

    def __init__(
        self,
        task: Task,
        me: Member,
        behaviour: Behaviour,
        strategy: ConsensusAlgorithm,
        outputs: EngagementOutputs,
        reporters: Reporters,
        token: int,
        now: float,
        age: float = 0.0,
    ) -> None:
        self.task = task
        self.state_machine = StateMachine()
        self.me = replace(me, status=self.state_machine.state.status)
        self.result: Result | None = None
        self.is_paused = False
        self.task_lease = TaskLease(token)
        self._outputs = outputs
        self._report_builder = ReportBuilder(behaviour, find_read_fields(strategy))
        self._execution = Execution(behaviour, task.stall_limit)
        self._decider = Decider(task, me.uuid, strategy, reporters)
        self._formation = Formation(me.uuid, behaviour)
        self._joined_at = now
        self._age = age

    @property
    def lease_client(self) -> LeaseClient | None:
        """The client of the task's lease; None while the robot is assigned to another task."""
        return self.task_lease.lease_client

    @property
    def is_over(self) -> bool:
        """Whether the task has an outcome."""
        return self.state_machine.state is State.DONE

    @property
    def is_acting(self) -> bool:
        """Whether the robot acts for this task or is about to."""
        return self.state_machine.state in (State.CLAIMING, State.EXECUTING)

    @property
    def can_yield_robot(self) -> bool:
        """Whether the robot may be given to a task of higher priority now."""
        if self.state_machine.state is State.RELEASING:
            return False
        return not self.is_acting or (self.task.preemptible and self._execution.is_safe)

    @property
    def task_group(self) -> TaskGroup | None:
        """The group with which the task is assigned, or None."""
        return self._decider.task_group

    def is_council_maintainer(self, now: float) -> bool:
        """Return whether this agent maintains the quorum: it acts, or no agent acts and it is the first by uuid."""
        return self.state_machine.state not in SETTLED_STATES and self._may_end_task(now)

    # -- inputs -----------------------------------------------------------------------------------------------------

    def join_group(self, task_group: TaskGroup, now: float) -> None:
        """Decide the task together with its group."""
        self._decider.task_group = task_group
        task_group.join(self.task, lambda now: [self.me, *self._decider.others(now)], now)

    def process_reports(self, members: list[Member], outcome: Result | None, now: float) -> None:
        """Process the present members, their reports, and the outcome of the task, if known; an outcome is final."""
        if outcome is not None and (self.result is None or outcome.rank > self.result.rank):
            self.result = outcome
            self.apply_event(Event.OUTCOME, now)
        self.me = self._decider.update_reports(members, self.me, now)
        if self.is_over:
            return
        if self.lease_client is not None and self.me.assigned not in (
            "",
            self.me.uuid,
            *(member.uuid for member in members),
        ):
            self.lease_client.suspect_holder()
        left = self._formation.update_members(self._decider.others(now))
        if left and self._decider.is_report_visible(now):
            self._outputs.log_event(
                f"a member left, {len(self._decider) + 1} remain: changes its post in the formation"
            )

    def process_order(self, order: Order | None) -> None:
        """Process the operator's newest order for the task."""
        was_paused, self.is_paused = self.is_paused, order is not None and order.word == PAUSE
        if order is not None and was_paused != self.is_paused and not self.is_over:
            self._outputs.log_event(f"{'paused' if self.is_paused else 'resumed'} by {order.by}")

    def update_task(self, task: Task) -> None:
        """Process a changed record of the task, except for its quorum if that is older than the known one."""
        self.task = task.with_newer_council(self.task)
        if self.lease_client is not None:
            self.lease_client.proposer.learn_charter(self.task.charter)

    def schedule_council_change(self, members: Sequence[Contact]) -> None:
        """Change the quorum of the task to ``members`` at the behaviour's next safe point."""
        self.task_lease.next_members = tuple(members)

    def set_load(self, load: int) -> None:
        """Set the number of tasks that the agent has."""
        self._report_builder.load = load

    def look(self, seen: Observation, now: float) -> None:
        """Process an observation, and report changes."""
        self._execution.look(seen, now)
        if not self._is_free or self.is_over or self._execution.has_stalled(now):
            return
        # In a group the robot may change tasks at any time. So its agent also reports a lower cost while it acts;
        # otherwise a nearly finished task would seem expensive.
        is_acting = self.state_machine.state is State.EXECUTING and self.task_group is None
        news = self._report_builder.find_changes(self.me, is_acting, seen, now)
        if news is not None:
            if "cost" in news:
                cost = news["cost"]
                self._outputs.log_event("has lost the target" if cost is None else f"reports {cost:.2f} m")
            self._publish(again=True, **news)

    # -- the robot --------------------------------------------------------------------------------------------------

    def take_robot(self, lease_client: LeaseClient, token: int) -> None:
        """Assign the robot, which has obeyed ``token``, to this task, whose lease ``lease_client`` requests."""
        self.task_lease.lease_client, self.task_lease.token = lease_client, token

    def set_robot_lent(self, is_lent: bool, now: float) -> None:
        """Record whether another task of the group uses the robot; if it does, this task stops acting."""
        if is_lent and self.lease_client is not None:
            if self.state_machine.state in SETTLED_STATES:
                return  # the lease is kept until the outcome is known
            self.apply_event(Event.LENT, now)
            self.task_lease.lease_client = None
        self.task_lease.is_lent = is_lent

    def yield_robot(self, why: str, now: float) -> None:
        """Give the robot to another task: stop it, release the lease, and report that the agent is not available."""
        if self.state_machine.state not in SETTLED_STATES:
            self.apply_event(Event.NO_BODY, now, replace(NO_DECISION, why=why))
            self.task_lease.lease_client = None

    def on_robot_lost(self) -> None:
        """Withdraw the report, because the robot does not respond; the next observation leads to a new report."""
        if self.me.available and not self.is_over:
            self._outputs.log_event("has lost its robot")
            self._publish(cost=None, available=False)

    def leave(self, now: float) -> Deferred[object]:
        """Leave the task: stop the robot if it acts, and release the lease.

        Fires when the quorum members know.
        """
        self.apply_event(Event.LEAVE, now)
        return self.task_lease.when_released

    # -- one turn ---------------------------------------------------------------------------------------------------

    def step(self, now: float) -> RobotCommand | None:
        """Decide again and return the next action; None if the robot has nothing to do for this task."""
        if self.state_machine.state in SETTLED_STATES:
            return None
        lease = self.task_lease.lease
        if self._is_past_deadline(now) and self.lease_client is not None and self._may_end_task(now):
            return self.apply_event(Event.EXPIRED if lease else Event.LATE, now, lease=lease)
        if not self._is_free:
            return self.apply_event(
                Event.NO_BODY, now, replace(NO_DECISION, why="paused" if self.is_paused else self.me.why)
            )
        if self.state_machine.state is State.IDLE:
            self.apply_event(Event.FREE, now)
        if self._execution.has_stalled(now) and self.me.cost is not None:
            self._outputs.log_event("makes no progress")
            self._publish(cost=None, available=False)
        if self.state_machine.state is State.EXECUTING:
            if self.task_lease.next_members and self._execution.is_safe:
                self.apply_event(Event.MOVE, now)
                lease = self.task_lease.lease
            if self.task_lease.is_changing_council(now):
                return None
        is_successor = self.state_machine.state is State.WAITING and lease is not None
        decision = self._decider.decide(self.task, self.me, now, is_successor)
        fault = self._decider.get_new_fault(decision)
        if fault:
            self._outputs.log_event(fault)
        return self.apply_event(self._determine_event(decision, lease), now, decision, lease)

    def _determine_event(self, decision: Decision, lease: Lease | None) -> Event:
        must_go_on = (
            self.state_machine.state is State.EXECUTING and self.me.cost is not None and not self._execution.is_safe
        )
        if decision.assigned == self.me.uuid or (must_go_on and decision.assigned is not None):
            return Event.GRANTED if lease else Event.NAMED
        if self.me.cost is None:
            return Event.BLIND
        if decision.assigned is None:
            return Event.UNDECIDED
        return Event.LEASED_IN_VAIN if lease else Event.PASSED_OVER

    @property
    def _is_free(self) -> bool:
        """Whether the robot is free for this task or for another task of its group."""
        return not self.is_paused and (self.lease_client is not None or self.task_lease.is_lent)

    def _may_end_task(self, now: float) -> bool:
        """Return whether this agent may end the task as failed: it acts, or it is the first agent by uuid."""
        return self.state_machine.state is State.EXECUTING or self._decider.is_first(now)

    def _is_past_deadline(self, now: float) -> bool:
        return 0.0 < self.task.deadline < self._age + now - self._joined_at

    # -- events and effects ----------------------------------------------------------------------------------------

    def apply_event(
        self, event: Event, now: float, decision: Decision = NO_DECISION, lease: Lease | None = None
    ) -> RobotCommand | None:
        """Apply ``event``, perform its effects in order, and return the resulting action for the robot, if any."""
        order, command = decision.ranking, None
        rank = order.index(self.me.uuid) if self.me.uuid in order else 0
        for effect in self.state_machine.apply(event, rank if order else None):
            command = self._perform_effect(effect, now, decision, lease)
        return command

    def _perform_effect(
        self, effect: Effect, now: float, decision: Decision, lease: Lease | None
    ) -> RobotCommand | None:
        task_lease, outputs = self.task_lease, self._outputs
        match effect:  # the effects of every step come first
            case Effect.WANT:
                task_lease.request()
            case Effect.EXECUTE:
                assert lease is not None
                return self._execute(decision, lease, now)
            case Effect.HOLD:
                return self._hold(decision, now)
            case Effect.STAND_BY:
                task_lease.stand_by(self._standby_rank(decision, now))
            case Effect.STOP:
                task_lease.record_stop(outputs.stop_robot(), now)
            case Effect.RELEASE:
                task_lease.release(now)
            case Effect.GIVE_BACK:
                outputs.log_event("releases the task")
                task_lease.release(now)
            case Effect.HAND_OVER:
                task_lease.when_released = task_lease.release(now, outputs.find_contacts(task_lease.standbys))
            case Effect.CLAIM:
                task_lease.start_request(now)
            case Effect.INSIST:
                if task_lease.retry_request(now):
                    self._publish(again=True)
            case Effect.CHANGE_COUNCIL:
                outputs.log_event(
                    f"replaces the quorum after the loss of a member: {len(task_lease.next_members)} members"
                )
                task_lease.change_council(now, self.task.lease_ttl)
            case Effect.OFFER:
                self.me = replace(self.me, available=True)
            case Effect.WITHDRAW:
                nothing: dict[str, Any] = {"cost": None, "assigned": "", "digest": "", "token": 0, "progress": None}
                self._publish(available=False, why=decision.why, post=None, **nothing)
            case Effect.START:
                outputs.log_event(f"acts: {decision.why}")
            case Effect.COMPLETE:
                self._record_outcome(COMPLETED, lease, now)
            case Effect.FAIL:
                self._record_outcome(FAILED, lease, now, f"past its deadline of {self.task.deadline:g} s")
            case Effect.END:
                assert self.result is not None
                by_me = self.result.outcome == COMPLETED and self.result.by == self.me.name
                why = f": {self.result.why}" if self.result.why else ""
                outputs.log_event("done" if by_me else f"{self.result.outcome.lower()} by {self.result.by}{why}")
                self._publish()
        return None

    def _execute(self, decision: Decision, lease: Lease, now: float) -> RobotCommand:
        self.task_lease.token = max(self.task_lease.token, lease.token)
        step = self._execution.step(now, lease.token, lease.deadline, decision.consensus)
        self._publish_decision(decision, lease.token, now, step.progress)
        if step.action is None:
            self.apply_event(Event.FINISHED, now, lease=lease)
        return RobotCommand(STAND if step.action is None else step.action, Permit(lease.token, lease.deadline))

    def _hold(self, decision: Decision, now: float) -> RobotCommand | None:
        if self.lease_client is None:  # another task of its group uses the robot
            self._publish_decision(decision, 0, now)
            return None
        post = None
        if self._decider.is_report_visible(now):  # only members with a visible report have a post in the formation
            post = self._formation.assign_post(self.me, self._decider.others(now), decision.assigned)
        self._publish_decision(decision, 0, now, post=post)
        action = self._execution.step_without_lease(self.me.cost is None, now)
        return RobotCommand(action, Permit(self.task_lease.token, now + SEARCH_TTL_S))

    def _standby_rank(self, decision: Decision, now: float) -> int:
        """Return the standby rank, from 1, of an agent that must be ready to take over immediately; 0 for others.

        The assigned agent is included as long as it does not act.
        """
        if not 0 < self.state_machine.rank <= STANDBYS:
            return 0
        others = self._decider.others(now)
        is_acting = any(member.uuid == decision.assigned and member.status == EXECUTING for member in others)
        return self.state_machine.rank + (not is_acting)

    def _record_outcome(self, outcome: str, lease: Lease | None, now: float, why: str = "") -> None:
        members = [self.me, *self._decider.others(now)]
        bids = sorted((m.name, m.cost) for m in members if m.cost is not None)
        token = 0 if lease is None else lease.token
        self._outputs.record_outcome(
            Result(outcome, self.me.name, round(now - self._joined_at, 2), token, tuple(bids), why)
        )

    def _publish_decision(
        self, decision: Decision, token: int, now: float, progress: float | None = None, post: float | None = None
    ) -> None:
        assigned = decision.assigned or ""
        if assigned and assigned != self.me.assigned and assigned != self.me.uuid:
            self._outputs.log_event(f"standby: {decision.why}")
        decided: dict[str, Any] = {"assigned": assigned, "digest": decision.digest, "why": decision.why}
        self._publish(token=token, progress=progress, post=post, **decided)
        self.task_lease.standbys = tuple(uuid for uuid in decision.ranking if uuid != self.me.uuid)[:STANDBYS]
        record = self._decider.make_record(decision, self.me, token, now)
        if record is not None:
            self._outputs.publish_decision_record(record)

    def _publish(self, again: bool = False, **changes: object) -> None:
        changes |= {"status": self.state_machine.state.status, "state": str(self.state_machine)}
        # a change of the round only is sent with the next report
        if again or any(getattr(self.me, name) != value for name, value in changes.items()):
            epoch = self._decider.epoch
            serial = self.me.serial + 1 if epoch == self.me.epoch else 0
            changes |= {"epoch": epoch, "serial": serial, "load": self._report_builder.load}
            self.me = replace(self.me, **changes)  # type: ignore[arg-type]
            self._outputs.publish_report(self.me)
