"""Engagement: one agent's part in one task, from assignment to end (Algorithm 4.5, revised).

Selection and commitment are two things here: ``decide`` says who should act, the lease who may.  Nothing is executed
without a lease that is valid now; when the decision or the lease goes elsewhere, the body stops first and the lease is
given back after.  Each turn finds one event, ``agents.state`` has what follows from it, and the effects are done here.
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
"""Seconds for which a motion that needs no lease (to look around) is allowed at a time."""
SETTLED = State.RELEASING, State.DONE
NOBODY = Decision(None, "", "")


@dataclass(frozen=True)
class Deed:
    """What the body is to do, and the permit under which it may."""

    action: Action
    permit: Permit


class Ports(Protocol):
    """The ways out of an engagement."""

    def tell(self, member: Member) -> None:
        """Publish this agent's report."""

    def conclude(self, result: Result) -> None:
        """Record the outcome."""

    def say(self, text: str) -> None:
        """Write a line for people."""

    def halt(self) -> float:
        """Stop the body now; the seconds for which it may still move because it does not hear that."""

    def justify(self, verdict: Verdict) -> None:
        """Publish why the agent decided so."""

    def reached(self, uuids: Sequence[str]) -> Sequence[Contact]:
        """The contacts of the agents with these uuids, as far as they are known."""


class Engagement:
    """One agent at one task.

    ``age`` is how old the task was ``now``, when the agent took it up; ``token`` is the highest that its body has
    obeyed so far.  The agent only listens until its body is given to this task, or to another of the task's group.
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
        self._began = now
        self._age = age

    @property
    def lessee(self) -> Lessee | None:
        """The client of the task's lease; None while the body is not this task's."""
        return self.claim.lessee

    @property
    def is_over(self) -> bool:
        """Whether the task has an outcome."""
        return self.course.state is State.DONE

    @property
    def is_acting(self) -> bool:
        """Whether the body acts for this task, or is about to."""
        return self.course.state in (State.CLAIMING, State.EXECUTING)

    @property
    def may_be_put_aside(self) -> bool:
        """Whether the body may go to another task of a higher priority now."""
        if self.course.state is State.RELEASING:
            return False
        return not self.is_acting or (self.task.preemptible and self._execution.is_safe)

    @property
    def division(self) -> Division | None:
        """What divides the task together with others, where it is of a group."""
        return self._conference.division

    def keeps_council(self, now: float) -> bool:
        """Whether it falls to this agent to look after the council: it acts, or is the first while nobody does."""
        return self.course.state not in SETTLED and self._may_fail(now)

    # -- what comes in ----------------------------------------------------------------------------------------------

    def join(self, division: Division, now: float) -> None:
        """Have the task divided together with others."""
        self._conference.division = division
        division.join(self.task, lambda now: [self.me, *self._conference.others(now)], now)

    def heard(self, members: list[Member], outcome: Result | None, now: float) -> None:
        """Take in who is present and what they report, and how the task ended.  An outcome absorbs all that follows."""
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
            self._ports.say(f"one left, {len(self._conference) + 1} here: spreads out")

    def ordered(self, order: Order | None) -> None:
        """Take in what an operator wants of the task."""
        was_paused, self.is_paused = self.is_paused, order is not None and order.word == PAUSE
        if order is not None and was_paused != self.is_paused and not self.is_over:
            self._ports.say(f"{'paused' if self.is_paused else 'resumed'} by {order.by}")

    def renewed(self, task: Task) -> None:
        """Take in what the records of the task say now; of its councils the newest stays."""
        self.task = task.with_newer_council(self.task)
        if self.lessee is not None:
            self.lessee.council.learn(self.task.charter)

    def hand_council(self, members: Sequence[Contact]) -> None:
        """Have ``members`` be the council of the task that it acts for, when the body comes to a safe point."""
        self.claim.successors = tuple(members)

    def set_load(self, load: int) -> None:
        """Take in the number of tasks that the agent has."""
        self._reporter.load = load

    def look(self, seen: Observation, now: float) -> None:
        """Take in what the body senses, and report when it is new to the others."""
        self._execution.look(seen, now)
        if not self._is_free or self.is_over or self._execution.has_stalled(now):
            return
        # In a group somebody is free now and then: what is nearly done must not look as far away as at its beginning.
        is_acting = self.course.state is State.EXECUTING and self.division is None
        news = self._reporter.news(self.me, is_acting, seen, now)
        if news is not None:
            if "cost" in news:
                cost = news["cost"]
                self._ports.say("lost sight of it" if cost is None else f"reports {cost:.2f} m")
            self._publish(again=True, **news)

    # -- the body ---------------------------------------------------------------------------------------------------

    def take_body(self, lessee: Lessee, token: int) -> None:
        """Have the body for this task, which has obeyed ``token``; ``lessee`` claims the task's lease."""
        self.claim.lessee, self.claim.token = lessee, token

    def lend_body(self, is_lent: bool, now: float) -> None:
        """Take in whether another task of the group has the body; where this task has it, it does not act."""
        if is_lent and self.lessee is not None:
            if self.course.state in SETTLED:
                return  # the lease is kept until the outcome is known
            self.on(Event.LENT, now)
            self.claim.lessee = None
        self.claim.is_lent = is_lent

    def put_aside(self, why: str, now: float) -> None:
        """Leave the body to another task: stop it where it acts, give the lease back, and say that it is not free."""
        if self.course.state not in SETTLED:
            self.on(Event.NO_BODY, now, replace(NOBODY, why=why))
            self.claim.lessee = None

    def lose_body(self) -> None:
        """Take the report back: the body does not answer, so nobody waits for it.  The next look reports again."""
        if self.me.available and not self.is_over:
            self._ports.say("has lost its robot")
            self._publish(cost=None, available=False)

    def abandon(self, now: float) -> Deferred[object]:
        """Leave the task: stop the body where it acts, and give the lease back, for good where the task is done.

        Fires when the council knows.
        """
        self.on(Event.LEAVE, now)
        return self.claim.released

    # -- one turn ---------------------------------------------------------------------------------------------------

    def step(self, now: float) -> Deed | None:
        """Decide again and say what to do now; None where there is nothing to do for this task."""
        if self.course.state in SETTLED:
            return None
        lease = self.claim.lease
        if self._is_late(now) and self.lessee is not None and self._may_fail(now):
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
        """Whether the body is free for the task, or for another of its group."""
        return not self.is_paused and (self.lessee is not None or self.claim.is_lent)

    def _may_fail(self, now: float) -> bool:
        """Whether it falls to this agent to end the task without success: it acts, or is the first of those present."""
        return self.course.state is State.EXECUTING or self._conference.is_first(now)

    def _is_late(self, now: float) -> bool:
        return 0.0 < self.task.deadline < self._age + now - self._began

    # -- events and effects ----------------------------------------------------------------------------------------

    def on(self, event: Event, now: float, decision: Decision = NOBODY, lease: Lease | None = None) -> Deed | None:
        """Take the step of ``event`` and do its effects in their order; the deed for the body, if there is one."""
        order, deed = decision.order, None
        rank = order.index(self.me.uuid) if self.me.uuid in order else 0
        for effect in self.course.go(event, rank if order else None):
            deed = self._do(effect, now, decision, lease)
        return deed

    def _do(self, effect: Effect, now: float, decision: Decision, lease: Lease | None) -> Deed | None:
        claim, ports = self.claim, self._ports
        match effect:  # the effects of each turn come first
            case Effect.WANT:
                claim.want()
            case Effect.EXECUTE:
                assert lease is not None
                return self._execute(decision, lease, now)
            case Effect.HOLD:
                return self._stand_by(decision, now)
            case Effect.STAND_BY:
                claim.stand_by(self._place(decision, now))
            case Effect.STOP:
                claim.stop(ports.halt(), now)
            case Effect.RELEASE:
                claim.release(now)
            case Effect.GIVE_BACK:
                ports.say("gives the task back")
                claim.release(now)
            case Effect.HAND_OVER:
                claim.released = claim.release(now, ports.reached(claim.standbys))
            case Effect.CLAIM:
                claim.begin(now)
            case Effect.INSIST:
                if claim.insist(now):
                    self._publish(again=True)
            case Effect.CHANGE_COUNCIL:
                ports.say(f"a member of the council is gone: {len(claim.successors)} from now on")
                claim.move(now, self.task.lease_ttl)
            case Effect.OFFER:
                self.me = replace(self.me, available=True)
            case Effect.WITHDRAW:
                nothing: dict[str, Any] = {"cost": None, "assigned": "", "digest": "", "token": 0, "progress": None}
                self._publish(available=False, why=decision.why, post=None, **nothing)
            case Effect.START:
                ports.say(f"goes: {decision.why}")
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

    def _stand_by(self, decision: Decision, now: float) -> Deed | None:
        if self.lessee is None:  # another task of its group has the body
            self._publish_decision(decision, 0, now)
            return None
        post = None
        if self._conference.counts(now):  # of a large team those close up who know of each other
            post = self._formation.close_up(self.me, self._conference.others(now), decision.assigned)
        self._publish_decision(decision, 0, now, post=post)
        action = self._execution.stand_by(self.me.cost is None, now)
        return Deed(action, Permit(self.claim.token, now + SEARCH_TTL))

    def _place(self, decision: Decision, now: float) -> int:
        """The place in the line, from 1, of one of the few that take over at once; who acts now is not one of these."""
        if not 0 < self.course.rank <= STANDBYS:
            return 0
        others = self._conference.others(now)
        is_acting = any(member.uuid == decision.assigned and member.status == EXECUTING for member in others)
        return self.course.rank + (not is_acting)

    def _conclude(self, outcome: str, lease: Lease | None, now: float, why: str = "") -> None:
        members = [self.me, *self._conference.others(now)]
        bids = sorted((m.name, m.cost) for m in members if m.cost is not None)
        token = 0 if lease is None else lease.token
        self._ports.conclude(Result(outcome, self.me.name, round(now - self._began, 2), token, tuple(bids), why))

    def _publish_decision(
        self, decision: Decision, token: int, now: float, progress: float | None = None, post: float | None = None
    ) -> None:
        assigned = decision.assigned or ""
        if assigned and assigned != self.me.assigned and assigned != self.me.uuid:
            self._ports.say(f"stands by: {decision.why}")
        told: dict[str, Any] = {"assigned": assigned, "digest": decision.digest, "why": decision.why}
        self._publish(token=token, progress=progress, post=post, **told)
        self.claim.standbys = tuple(uuid for uuid in decision.order if uuid != self.me.uuid)[:STANDBYS]
        verdict = self._conference.account(decision, self.me, token, now)
        if verdict is not None:
            self._ports.justify(verdict)

    def _publish(self, again: bool = False, **changes: object) -> None:
        changes |= {"status": self.course.state.status, "state": str(self.course)}
        # A round alone is told with the next report.
        if again or any(getattr(self.me, name) != value for name, value in changes.items()):
            epoch = self._conference.epoch
            serial = self.me.serial + 1 if epoch == self.me.epoch else 0
            changes |= {"epoch": epoch, "serial": serial, "load": self._reporter.load}
            self.me = replace(self.me, **changes)  # type: ignore[arg-type]
            self._ports.tell(self.me)
