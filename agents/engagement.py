"""One agent's part in one task, from assignment to end (Algorithm 4.5, revised).

Selection and commitment are separate: ``decide`` selects the agent that should act, and the lease gives it the right to
act.  An agent executes only under a valid lease.  When the decision or the lease changes, the agent first stops the
robot, then releases the lease.  Each turn determines one event; the table in ``agents.state`` gives its effects, which
are performed here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from twisted.internet.defer import Deferred

from agents.behaviour import Behaviour
from agents.claim import STANDBYS, Claim
from agents.conference import Conference
from agents.decision import Decision
from agents.division import Division
from agents.execution import Execution
from agents.formation import Formation
from agents.means import STAND
from agents.report import Reporter
from agents.state import Course, Effect, Event, State
from drivers.driver import Permit
from drivers.reading import Action, Observation
from middleware.consensus.bidding.panel import Panel
from middleware.consensus.lease.lessee import Lease, Lessee
from middleware.consensus.strategy import ConsensusAlgorithm, reads_of
from middleware.consensus.verdict import Verdict
from middleware.directory.presence import EXECUTING
from middleware.entangled.contact import Contact
from middleware.tasks.order import PAUSE, Order
from middleware.tasks.task import COMPLETED, FAILED, Member, Result, Task

SEARCH_TTL = 0.5
"""Seconds for which a motion without a lease (looking around) is permitted at a time."""
SETTLED = State.RELEASING, State.DONE
NOBODY = Decision(None, "", "")


@dataclass(frozen=True)
class Deed:
    """An action for the robot and its permit."""

    action: Action
    permit: Permit


class Ports(Protocol):
    """The outputs of an engagement."""

    def tell(self, member: Member) -> None:
        """Publish this agent's report."""

    def conclude(self, result: Result) -> None:
        """Record the outcome."""

    def say(self, text: str) -> None:
        """Write a line to the device's log on the page."""

    def halt(self) -> float:
        """Stop the robot; return the seconds for which it may still move if it does not respond."""

    def justify(self, verdict: Verdict) -> None:
        """Publish the record of a decision."""

    def reached(self, uuids: Sequence[str]) -> Sequence[Contact]:
        """Return the known contacts of the agents with these uuids."""


class Engagement:
    """One agent's part in one task.

    ``age`` is the age of the task in seconds at ``now``, when the agent joined it; ``token`` is the highest fencing
    token that the robot has obeyed.  Until the robot is assigned to this task, or to another one of its group, the
    agent only listens.
    """

    def __init__(
        self,
        task: Task,
        me: Member,
        behaviour: Behaviour,
        strategy: ConsensusAlgorithm,
        ports: Ports,
        panel: Panel,
        token: int,
        now: float,
        age: float = 0.0,
    ) -> None:
        self.task = task
        self.course = Course()
        self.me = replace(me, status=self.course.state.status)
        self.result: Result | None = None
        self.is_paused = False
        self.claim = Claim(token)
        self._ports = ports
        self._reporter = Reporter(behaviour, reads_of(strategy))
        self._execution = Execution(behaviour, task.stall_limit)
        self._conference = Conference(task, me.uuid, strategy, panel)
        self._formation = Formation(me.uuid, behaviour)
        self._joined_at = now
        self._age = age

    @property
    def lessee(self) -> Lessee | None:
        """The client of the task's lease; None while another task has the robot."""
        return self.claim.lessee

    @property
    def is_over(self) -> bool:
        """Whether the task has an outcome."""
        return self.course.state is State.DONE

    @property
    def is_acting(self) -> bool:
        """Whether the robot acts for this task or is about to."""
        return self.course.state in (State.CLAIMING, State.EXECUTING)

    @property
    def may_be_put_aside(self) -> bool:
        """Whether the robot may be given to a task of higher priority now."""
        if self.course.state is State.RELEASING:
            return False
        return not self.is_acting or (self.task.preemptible and self._execution.is_safe)

    @property
    def division(self) -> Division | None:
        """The group with which the task is assigned, or None."""
        return self._conference.division

    def keeps_council(self, now: float) -> bool:
        """Return whether this agent maintains the quorum: it acts, or it is the first while no agent acts."""
        return self.course.state not in SETTLED and self._may_end_task(now)

    # -- inputs -----------------------------------------------------------------------------------------------------

    def join(self, division: Division, now: float) -> None:
        """Decide the task together with its group."""
        self._conference.division = division
        division.join(self.task, lambda now: [self.me, *self._conference.others(now)], now)

    def heard(self, members: list[Member], outcome: Result | None, now: float) -> None:
        """Process the present members, their reports, and the outcome if there is one; the outcome is final."""
        if outcome is not None and (self.result is None or outcome.rank > self.result.rank):
            self.result = outcome
            self.on(Event.OUTCOME, now)
        self.me = self._conference.hear(members, self.me, now)
        if self.is_over:
            return
        if self.lessee is not None and self.me.assigned not in ("", self.me.uuid, *(member.uuid for member in members)):
            self.lessee.suspect()
        left = self._formation.hear(self._conference.others(now))
        if left and self._conference.counts(now):
            self._ports.say(f"a member left, {len(self._conference) + 1} remain: changes its place in the formation")

    def ordered(self, order: Order | None) -> None:
        """Process the operator's newest order for the task."""
        was_paused, self.is_paused = self.is_paused, order is not None and order.word == PAUSE
        if order is not None and was_paused != self.is_paused and not self.is_over:
            self._ports.say(f"{'paused' if self.is_paused else 'resumed'} by {order.by}")

    def renewed(self, task: Task) -> None:
        """Process a changed record of the task; the newest quorum is kept."""
        self.task = task.with_newer_council(self.task)
        if self.lessee is not None:
            self.lessee.council.learn(self.task.charter)

    def hand_council(self, members: Sequence[Contact]) -> None:
        """Change the quorum of the task to ``members`` at the behaviour's next safe point."""
        self.claim.successors = tuple(members)

    def set_load(self, load: int) -> None:
        """Set the number of tasks that the agent has."""
        self._reporter.load = load

    def look(self, seen: Observation, now: float) -> None:
        """Process an observation, and report changes."""
        self._execution.look(seen, now)
        if not self._is_free or self.is_over or self._execution.has_stalled(now):
            return
        # In a group the robot is free between tasks, so a task that is nearly done must report its reduced cost.
        is_acting = self.course.state is State.EXECUTING and self.division is None
        news = self._reporter.news(self.me, is_acting, seen, now)
        if news is not None:
            if "cost" in news:
                cost = news["cost"]
                self._ports.say("has lost the target" if cost is None else f"reports {cost:.2f} m")
            self._publish(again=True, **news)

    # -- the robot --------------------------------------------------------------------------------------------------

    def take_body(self, lessee: Lessee, token: int) -> None:
        """Assign the robot to this task; it has obeyed ``token``, and ``lessee`` is the client of the task's lease."""
        self.claim.lessee, self.claim.token = lessee, token

    def lend_body(self, is_lent: bool, now: float) -> None:
        """Record whether another task of the group has the robot; if this task had it, it stops acting."""
        if is_lent and self.lessee is not None:
            if self.course.state in SETTLED:
                return  # the lease is kept until the outcome is known
            self.on(Event.LENT, now)
            self.claim.lessee = None
        self.claim.is_lent = is_lent

    def put_aside(self, why: str, now: float) -> None:
        """Give the robot to another task: stop it, release the lease, and report that the agent is not available."""
        if self.course.state not in SETTLED:
            self.on(Event.NO_BODY, now, replace(NOBODY, why=why))
            self.claim.lessee = None

    def lose_body(self) -> None:
        """Withdraw the report, because the robot does not respond; the next observation reports again."""
        if self.me.available and not self.is_over:
            self._ports.say("has lost its robot")
            self._publish(cost=None, available=False)

    def abandon(self, now: float) -> Deferred[object]:
        """Leave the task: stop the robot if it acts, and release the lease.

        Fires when the quorum members know.
        """
        self.on(Event.LEAVE, now)
        return self.claim.released

    # -- one turn ---------------------------------------------------------------------------------------------------

    def step(self, now: float) -> Deed | None:
        """Decide again and return the next action; None if there is nothing to do for this task."""
        if self.course.state in SETTLED:
            return None
        lease = self.claim.lease
        if self._is_past_deadline(now) and self.lessee is not None and self._may_end_task(now):
            return self.on(Event.EXPIRED if lease else Event.LATE, now, lease=lease)
        if not self._is_free:
            return self.on(Event.NO_BODY, now, replace(NOBODY, why="paused" if self.is_paused else self.me.why))
        if self.course.state is State.IDLE:
            self.on(Event.FREE, now)
        if self._execution.has_stalled(now) and self.me.cost is not None:
            self._ports.say("makes no progress")
            self._publish(cost=None, available=False)
        if self.course.state is State.EXECUTING:
            if self.claim.successors and self._execution.is_safe:
                self.on(Event.MOVE, now)
                lease = self.claim.lease
            if self.claim.is_moving(now):
                return None
        is_successor = self.course.state is State.WAITING and lease is not None
        decision = self._conference.decide(self.task, self.me, now, is_successor)
        fault = self._conference.new_fault(decision)
        if fault:
            self._ports.say(fault)
        return self.on(self._event_of(decision, lease), now, decision, lease)

    def _event_of(self, decision: Decision, lease: Lease | None) -> Event:
        must_go_on = self.course.state is State.EXECUTING and self.me.cost is not None and not self._execution.is_safe
        if decision.assigned == self.me.uuid or (must_go_on and decision.assigned is not None):
            return Event.GRANTED if lease else Event.NAMED
        if self.me.cost is None:
            return Event.BLIND
        if decision.assigned is None:
            return Event.UNDECIDED
        return Event.LEASED_IN_VAIN if lease else Event.PASSED_OVER

    @property
    def _is_free(self) -> bool:
        """Whether the robot is free for the task, or for another of its group."""
        return not self.is_paused and (self.lessee is not None or self.claim.is_lent)

    def _may_end_task(self, now: float) -> bool:
        """Return whether this agent may end the task as failed: it acts, or is the first of the present agents."""
        return self.course.state is State.EXECUTING or self._conference.is_first(now)

    def _is_past_deadline(self, now: float) -> bool:
        return 0.0 < self.task.deadline < self._age + now - self._joined_at

    # -- events and effects ----------------------------------------------------------------------------------------

    def on(self, event: Event, now: float, decision: Decision = NOBODY, lease: Lease | None = None) -> Deed | None:
        """Apply ``event``, perform its effects in order, and return the resulting action for the robot, if any."""
        order, deed = decision.order, None
        rank = order.index(self.me.uuid) if self.me.uuid in order else 0
        for effect in self.course.go(event, rank if order else None):
            deed = self._do(effect, now, decision, lease)
        return deed

    def _do(self, effect: Effect, now: float, decision: Decision, lease: Lease | None) -> Deed | None:
        claim, ports = self.claim, self._ports
        match effect:  # the effects of every turn come first
            case Effect.WANT:
                claim.want()
            case Effect.EXECUTE:
                assert lease is not None
                return self._execute(decision, lease, now)
            case Effect.HOLD:
                return self._hold(decision, now)
            case Effect.STAND_BY:
                claim.stand_by(self._standby_rank(decision, now))
            case Effect.STOP:
                claim.stop(ports.halt(), now)
            case Effect.RELEASE:
                claim.release(now)
            case Effect.GIVE_BACK:
                ports.say("releases the task")
                claim.release(now)
            case Effect.HAND_OVER:
                claim.released = claim.release(now, ports.reached(claim.standbys))
            case Effect.CLAIM:
                claim.begin(now)
            case Effect.INSIST:
                if claim.insist(now):
                    self._publish(again=True)
            case Effect.CHANGE_COUNCIL:
                ports.say(f"replaces the quorum after the loss of a member: {len(claim.successors)} members")
                claim.move(now, self.task.lease_ttl)
            case Effect.OFFER:
                self.me = replace(self.me, available=True)
            case Effect.WITHDRAW:
                nothing: dict[str, Any] = {"cost": None, "assigned": "", "digest": "", "token": 0, "progress": None}
                self._publish(available=False, why=decision.why, post=None, **nothing)
            case Effect.START:
                ports.say(f"acts: {decision.why}")
            case Effect.COMPLETE:
                self._conclude(COMPLETED, lease, now)
            case Effect.FAIL:
                self._conclude(FAILED, lease, now, f"past its deadline of {self.task.deadline:g} s")
            case Effect.END:
                assert self.result is not None
                by_me = self.result.outcome == COMPLETED and self.result.by == self.me.name
                why = f": {self.result.why}" if self.result.why else ""
                ports.say("done" if by_me else f"{self.result.outcome.lower()} by {self.result.by}{why}")
                self._publish()
        return None

    def _execute(self, decision: Decision, lease: Lease, now: float) -> Deed:
        self.claim.token = max(self.claim.token, lease.token)
        turn = self._execution.go_on(now, lease.token, lease.deadline, decision.consensus)
        self._publish_decision(decision, lease.token, now, turn.progress)
        if turn.action is None:
            self.on(Event.FINISHED, now, lease=lease)
        return Deed(STAND if turn.action is None else turn.action, Permit(lease.token, lease.deadline))

    def _hold(self, decision: Decision, now: float) -> Deed | None:
        if self.lessee is None:  # another task of its group has the robot
            self._publish_decision(decision, 0, now)
            return None
        post = None
        if self._conference.counts(now):  # only members with a visible report take a place in the formation
            post = self._formation.close_up(self.me, self._conference.others(now), decision.assigned)
        self._publish_decision(decision, 0, now, post=post)
        action = self._execution.stand_by(self.me.cost is None, now)
        return Deed(action, Permit(self.claim.token, now + SEARCH_TTL))

    def _standby_rank(self, decision: Decision, now: float) -> int:
        """Return the standby rank, from 1, of an agent that is to take over at once; 0 otherwise.

        The assigned agent counts until it acts.
        """
        if not 0 < self.course.rank <= STANDBYS:
            return 0
        others = self._conference.others(now)
        is_acting = any(member.uuid == decision.assigned and member.status == EXECUTING for member in others)
        return self.course.rank + (not is_acting)

    def _conclude(self, outcome: str, lease: Lease | None, now: float, why: str = "") -> None:
        members = [self.me, *self._conference.others(now)]
        bids = sorted((m.name, m.cost) for m in members if m.cost is not None)
        token = 0 if lease is None else lease.token
        self._ports.conclude(Result(outcome, self.me.name, round(now - self._joined_at, 2), token, tuple(bids), why))

    def _publish_decision(
        self, decision: Decision, token: int, now: float, progress: float | None = None, post: float | None = None
    ) -> None:
        assigned = decision.assigned or ""
        if assigned and assigned != self.me.assigned and assigned != self.me.uuid:
            self._ports.say(f"standby: {decision.why}")
        decided: dict[str, Any] = {"assigned": assigned, "digest": decision.digest, "why": decision.why}
        self._publish(token=token, progress=progress, post=post, **decided)
        self.claim.standbys = tuple(uuid for uuid in decision.order if uuid != self.me.uuid)[:STANDBYS]
        verdict = self._conference.account(decision, self.me, token, now)
        if verdict is not None:
            self._ports.justify(verdict)

    def _publish(self, again: bool = False, **changes: object) -> None:
        changes |= {"status": self.course.state.status, "state": str(self.course)}
        # a new round alone is sent with the next report
        if again or any(getattr(self.me, name) != value for name, value in changes.items()):
            epoch = self._conference.epoch
            serial = self.me.serial + 1 if epoch == self.me.epoch else 0
            changes |= {"epoch": epoch, "serial": serial, "load": self._reporter.load}
            self.me = replace(self.me, **changes)  # type: ignore[arg-type]
            self._ports.tell(self.me)
