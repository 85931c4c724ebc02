"""Engagement: one agent's part in one task, from assignment to end (Algorithm 4.5, revised).

Selection and commitment are two things here: ``decide`` says who should act, the lease who may.  Nothing is executed
without a lease that is valid now; when the decision or the lease goes elsewhere, the body stops first and the lease is
given back after.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReactorTime

from agents.account import Account
from agents.behaviour import Behaviour
from agents.conference import Conference
from agents.decision import Decision
from agents.division import Division
from agents.execution import Execution
from agents.formation import Formation
from agents.means import STAND
from agents.report import Reporter
from agents.state import Course, State
from drivers.driver import Permit
from drivers.reading import Action, Observation
from middleware.consensus.bidding.panel import Panel
from middleware.consensus.lease.lessee import Lease, Lessee
from middleware.consensus.strategy import ConsensusAlgorithm, reads_of
from middleware.consensus.verdict import Verdict
from middleware.directory.presence import EXECUTING
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError
from middleware.tasks.order import PAUSE, Order
from middleware.tasks.task import COMPLETED, FAILED, Member, Result, Task

HEIRS = 2
"""So many of those that wait are ready to take over at once: each asks the council now and then."""
INSISTING = 1.0
"""Seconds after which who is to act, and is not let, says so again: whoever acts may think that it has given up."""
SEARCH_TTL = 0.5
"""Seconds for which a motion that needs no lease (to look around) is allowed at a time."""


@dataclass(frozen=True)
class Deed:
    """What the body is to do, and the permit under which it may."""

    action: Action
    permit: Permit


class Engagement:
    """One agent at one task.

    ``tell`` publishes this agent's report; ``conclude`` records the outcome; ``say`` writes a line for people; ``halt``
    stops the body now, and says for how many seconds it may still move because it does not hear that; ``token`` is the
    highest token that the body has obeyed so far; ``age`` is how old the task was when the agent took it up.  With a
    ``lessee`` the agent has its body for this task, without one it only listens; and where ``is_lent`` says that
    another task of its group has the body, it reports and decides all the same.
    ``justify`` is told why, at each decision; ``reached`` knows how the agents of some uuids are reached.
    """

    def __init__(
        self,
        task: Task,
        me: Member,
        behaviour: Behaviour,
        strategy: ConsensusAlgorithm,
        clock: IReactorTime,
        token: int,
        tell: Callable[[Member], None],
        conclude: Callable[[Result], None],
        say: Callable[[str], None],
        halt: Callable[[], float],
        age: float = 0.0,
    ) -> None:
        self.task = task
        self.course = Course()
        self.me = replace(me, status=State.IDLE.status)
        self.result: Result | None = None
        self.order: Order | None = None
        self.token = token
        self.lessee: Lessee | None = None
        self.is_lent = False
        self.justify: Callable[[Verdict], None] = lambda verdict: None
        self.reached: Callable[[Sequence[str]], Sequence[Contact]] = lambda uuids: ()
        self._heirs: tuple[str, ...] = ()
        self._successors: tuple[Contact, ...] = ()
        self._rests_until = 0.0
        self._insists_at = 0.0
        self._stands_at = 0.0
        self._reporter = Reporter(behaviour, clock, reads_of(strategy))
        self._behaviour = behaviour
        self._execution = Execution(behaviour, task.stall_limit)
        self._clock = clock
        self._tell = tell
        self._conclude = conclude
        self._say = say
        self._halt = halt
        self._conference = Conference(me.uuid, strategy)
        self._account = Account(task, strategy)
        self._formation = Formation(me.uuid, behaviour)
        self._began = clock.seconds()
        self._age = age
        self.load = 1
        self._fault = ""
        self._concluding = False

    @property
    def is_over(self) -> bool:
        """Whether the task has an outcome."""
        return self.result is not None

    @property
    def is_paused(self) -> bool:
        """Whether an operator wants the task to rest."""
        return self.order is not None and self.order.word == PAUSE

    @property
    def division(self) -> Division | None:
        """What divides the task together with others, where it is of a group."""
        return self._conference.division

    def join(self, division: Division) -> None:
        """Have the task divided together with others."""
        self._conference.division = division
        division.join(self.task, self._members, self._clock.seconds())

    def seat(self, panel: Panel) -> None:
        """Have ``panel`` say whose records stand for the group."""
        self._conference.panel = panel

    def _members(self, now: float) -> list[Member]:
        return [self.me, *self._conference.others(now)]

    @property
    def is_acting(self) -> bool:
        """Whether the body acts for this task, or is about to."""
        return self.course.state in (State.CLAIMING, State.EXECUTING)

    @property
    def keeps_council(self) -> bool:
        """Whether it falls to this agent to look after the council: it acts, or is the first while nobody does."""
        is_acting = self.course.state is State.EXECUTING
        return not (self.is_over or self._concluding) and (
            is_acting or self._conference.is_first(self._clock.seconds())
        )

    @property
    def may_be_put_aside(self) -> bool:
        """Whether the body may go to another task of a higher priority now."""
        if self._concluding:
            return False
        return not self.is_acting or (self.task.preemptible and self._execution.is_safe)

    # -- what comes in ----------------------------------------------------------------------------------------------

    def heard(self, members: list[Member], outcome: Result | None) -> None:
        """Take in who is present and what they report, and how the task ended.  An outcome absorbs all that follows."""
        now = self._clock.seconds()
        if outcome is not None and (self.result is None or outcome.rank > self.result.rank):
            self._end(outcome)
        self.me = self._conference.hear(members, self.me, now)
        assigned = self.me.assigned
        if self.lessee is not None and assigned not in ("", self.me.uuid, *(member.uuid for member in members)):
            self.lessee.suspect()
        left = self._formation.hear(self._conference.others(now))
        if left and self._conference.counts(now) and not self.is_over:
            self._say(f"one left, {len(self._conference) + 1} here: spreads out")

    def ordered(self, order: Order | None) -> None:
        """Take in what an operator wants of the task."""
        was_paused, self.order = self.is_paused, order
        if order is not None and was_paused != self.is_paused and not self.is_over:
            self._say(f"{'paused' if self.is_paused else 'resumed'} by {order.by}")

    def renewed(self, task: Task) -> None:
        """Take in what the records of the task say now; of its councils the newest stays."""
        self.task = task.with_newer_council(self.task)
        if self.lessee is not None:
            self.lessee.council.learn(self.task.charter)

    def hand_council(self, members: Sequence[Contact]) -> None:
        """Have ``members`` be the council of the task that it acts for, when the body comes to a safe point."""
        self._successors = tuple(members)

    def look(self, seen: Observation) -> None:
        """Take in what the body senses, and report when it is new to the others."""
        now = self._clock.seconds()
        self._behaviour.look(seen, now)
        is_free = self.lessee is not None or self.is_lent
        if not is_free or self.is_paused or self.is_over or self._execution.has_stalled(now):
            return
        # In a group somebody is free now and then: what is nearly done must not look as far away as at its beginning.
        is_acting = self.course.state is State.EXECUTING and self.division is None
        news = self._reporter.news(self.me, is_acting, seen, self.load)
        if news is not None:
            if "cost" in news:
                cost = news["cost"]
                self._say("lost sight of it" if cost is None else f"reports {cost:.2f} m")
            self._publish(again=True, **news)

    def lose_body(self) -> None:
        """Take the report back: the body does not answer, so nobody waits for it.  The next look reports again."""
        if self.me.available and not self.is_over:
            self._say("has lost its robot")
            self._publish(cost=None, available=False)

    # -- what goes out ----------------------------------------------------------------------------------------------

    def step(self) -> Deed | None:
        """Decide again and say what to do now; None where there is nothing to do for this task."""
        if self.is_over or self._concluding:
            return None
        now = self._clock.seconds()
        if self._is_late(now) and self.lessee is not None and self._may_fail(now):
            if self.lessee.lease is not None:
                self._finish(FAILED, f"past its deadline of {self.task.deadline:g} s")
            else:
                self._stop(State.FENCED)
                self.lessee.want()  # an agent ends only what it holds
            return None
        if self.is_paused or (self.lessee is None and not self.is_lent):
            self._rest_aside("paused" if self.is_paused else self.me.why)
            return None
        if self.course.state is State.IDLE:
            self.course.go(State.OBSERVING)
            self.me = replace(self.me, available=True)
        if self._execution.has_stalled(now) and self.me.cost is not None:
            self._say("makes no progress")
            self._publish(cost=None, available=False)
        if self.lessee is None:  # another task of its group has the body
            decision = self._decision(now)
            self._place(decision)
            self._publish_decision(decision, 0)
            return None
        is_executing = self.course.state is State.EXECUTING
        if is_executing and self._successors and self._execution.is_safe:
            self._move_council(now)
        if is_executing and self.lessee.lease is None and now < self._rests_until:
            return None
        decision = self._decision(now)
        if decision.assigned == self.me.uuid or self._must_go_on(decision):
            return self._act(decision, now)
        self._yield()
        self._place(decision)
        self._line_up(decision)
        return self._stand_by(decision, now)

    def fence(self) -> None:
        """The body has obeyed a newer token than the one it acts under: another holds the task, or held it.

        To an agent that only stands by it says nothing: the body remembers what a former life of its agent did.
        """
        if self._stop(State.FENCED) and self.lessee is not None:
            self.lessee.release()

    def put_aside(self, why: str) -> None:
        """Leave the body to another task: stop it where it acts, give the lease back, and say that it is not free."""
        if self._concluding:
            return  # the lease is kept until the outcome is known
        self._rest_aside(why)
        self.lessee = None

    def lend(self) -> None:
        """Leave the body, which does not act, to another task of the group."""
        self._yield()
        if self.lessee is not None:
            self.lessee.release()
        self.lessee, self.is_lent = None, True

    def abandon(self) -> Deferred[object]:
        """Leave the task: stop the body where it acts, and give the lease back, for good where the task is done.

        Fires when the council knows.
        """
        if self.lessee is None:
            return succeed(None)
        self._stop(State.RELEASING)
        return self.lessee.release(self.reached(self._heirs), self._rest)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _decision(self, now: float) -> Decision:
        decision = self._conference.decide(self.task, self.me, now)
        for _ in range(len(self._conference)):
            if self.lessee is None or self.lessee.lease is None or self.course.state is not State.WAITING:
                break
            # It stood by and the lease is its own: who was to act has given up, and the news of that is on its way.
            if decision.assigned in (None, self.me.uuid):
                break
            self._conference.dismiss(str(decision.assigned))
            decision = self._conference.decide(self.task, self.me, now)
        if decision.fault and decision.fault != self._fault:
            self._say(decision.fault)
        self._fault = decision.fault
        return decision

    def _act(self, decision: Decision, now: float) -> Deed:
        assert self.lessee is not None
        self.lessee.want()
        lease = self.lessee.lease
        if lease is None:
            if not self._stop(State.FENCED):
                self._claim(decision, now)
            return self._stand_by(decision, now)
        if self.course.state is not State.EXECUTING:
            self._place(decision)
            self.course.go(State.EXECUTING)
            self._say(f"goes: {decision.why}")
        self.token = max(self.token, lease.token)
        turn = self._execution.go_on(now, lease.token, lease.deadline, decision.consensus)
        self._publish_decision(decision, lease.token, turn.progress)
        if turn.action is None:
            self._finish(COMPLETED)
            return Deed(STAND, self._permit(lease))
        return Deed(turn.action, self._permit(lease))

    def _claim(self, decision: Decision, now: float) -> None:
        was = self.course.state
        self._place(decision)
        if self.course.state is not State.CLAIMING:
            return
        if was is not State.CLAIMING:
            self._insists_at = now + INSISTING
        elif now >= self._insists_at:
            self._insists_at = now + INSISTING
            self._publish(again=True)

    def _stand_by(self, decision: Decision, now: float) -> Deed:
        post = None
        if self._conference.counts(now):  # of a large team those close up who know of each other
            post = self._formation.close_up(self.me, self._conference.others(now), decision.assigned)
        self._publish_decision(decision, 0, post=post)
        searching = self.me.cost is None
        action = self._behaviour.search(now) if searching else self._behaviour.hold(now)
        return Deed(action, Permit(self.token, now + SEARCH_TTL))

    def _permit(self, lease: Lease) -> Permit:
        return Permit(lease.token, lease.deadline)

    def _move_council(self, now: float) -> None:
        """Stop the body, and only then have the council changed; it goes on when it has its lease again."""
        assert self.lessee is not None
        members, self._successors = self._successors, ()
        self._halt()
        self._rests_until = now + self.task.lease_ttl
        self._say(f"a member of the council is gone: {len(members)} from now on")
        self.lessee.move(members).addErrback(lambda failure: failure.trap(EntangledError))

    def _place(self, decision: Decision) -> None:
        """Go to the state that the decision means for who does not execute."""
        if self.me.cost is None:
            self.course.reach(State.OBSERVING)
        elif decision.assigned is None:
            self.course.reach(State.REPORTED)
        elif decision.assigned == self.me.uuid:
            self.course.reach(State.CLAIMING)
        else:
            order = decision.order
            self.course.reach(State.WAITING, order.index(self.me.uuid) if self.me.uuid in order else 0)

    def _must_go_on(self, decision: Decision) -> bool:
        """Whether another should act, and this agent is at no point where the task may change hands."""
        is_executing = self.course.state is State.EXECUTING and self.me.cost is not None
        return is_executing and decision.assigned is not None and not self._execution.is_safe

    def _publish_decision(
        self, decision: Decision, token: int, progress: float | None = None, post: float | None = None
    ) -> None:
        assigned = decision.assigned or ""
        if assigned and assigned != self.me.assigned and assigned != self.me.uuid:
            self._say(f"stands by: {decision.why}")
        told: dict[str, Any] = {"assigned": assigned, "digest": decision.digest, "why": decision.why}
        self._publish(token=token, progress=progress, post=post, **told)
        self._heirs = tuple(uuid for uuid in decision.order if uuid != self.me.uuid)[:HEIRS]
        now = self._clock.seconds()
        verdict = self._account.of(decision, self.me, self._conference.others(now), token, now)
        if verdict is not None:
            self.justify(verdict)

    def _publish(self, again: bool = False, **changes: object) -> None:
        changes |= {"status": self.course.state.status, "state": str(self.course)}
        # A round alone is told with the next report.
        if again or any(getattr(self.me, name) != value for name, value in changes.items()):
            epoch = self._conference.epoch
            serial = self.me.serial + 1 if epoch == self.me.epoch else 0
            changes |= {"epoch": epoch, "serial": serial, "load": self.load}
            self.me = replace(self.me, **changes)  # type: ignore[arg-type]
            self._tell(self.me)

    def _yield(self) -> None:
        """Let another act.  Who only stands by, and holds nothing, keeps its place in the line."""
        if self.is_acting or (self.lessee is not None and self.lessee.lease is not None):
            self._give_back()

    def _line_up(self, decision: Decision) -> None:
        """Be ready to take over at once, where few are before this agent; who acts now is not one of these."""
        assert self.lessee is not None
        if self.course.state is State.WAITING and 0 < self.course.rank <= HEIRS:
            others = self._conference.others(self._clock.seconds())
            is_acting = any(member.uuid == decision.assigned and member.status == EXECUTING for member in others)
            self.lessee.stand_by(self.course.rank + (not is_acting))
        else:
            self.lessee.release()

    def _give_back(self) -> None:
        """Stop the body where it acts, and only then give the lease back."""
        if self._stop(State.RELEASING):
            self._say("gives the task back")
        if self.lessee is not None:
            self.lessee.release(rest=self._rest)

    def _stop(self, state: State) -> bool:
        """Stop the body where it acts, which leads to ``state``; whether it did."""
        if self.course.state is not State.EXECUTING:
            return False
        self._stands_at = self._clock.seconds() + self._halt()
        self.course.go(state)
        return True

    @property
    def _rest(self) -> float:
        """Seconds for which the body may still move though it was stopped."""
        return max(0.0, self._stands_at - self._clock.seconds())

    def _rest_aside(self, why: str) -> None:
        """Have no body for this task; who is to be asked for a report is another."""
        self._give_back()
        self.course.go(State.IDLE)
        nothing: dict[str, Any] = {"cost": None, "assigned": "", "digest": "", "token": 0, "progress": None}
        self._publish(available=False, why=why, post=None, **nothing)

    def _finish(self, outcome: str, why: str = "") -> None:
        """Record the outcome; the lease is kept until the outcome is known, so that nobody starts over in between."""
        self._concluding = True
        now = self._clock.seconds()
        lease = None if self.lessee is None else self.lessee.lease
        self._stop(State.RELEASING)
        members = [self.me, *self._conference.others(now)]
        bids = sorted((m.name, m.cost) for m in members if m.cost is not None)
        token = 0 if lease is None else lease.token
        self._conclude(Result(outcome, self.me.name, round(now - self._began, 2), token, tuple(bids), why))

    def reopen(self) -> None:
        """The task is another's by now: a higher token was granted before the end under this one was recorded."""
        self._concluding = False
        if self.lessee is not None:
            self.lessee.release()

    def _may_fail(self, now: float) -> bool:
        """Whether it falls to this agent to end the task without success: it acts, or is the first of those present."""
        return self.course.state is State.EXECUTING or self._conference.is_first(now)

    def _is_late(self, now: float) -> bool:
        return 0.0 < self.task.deadline < self._age + now - self._began

    def _end(self, outcome: Result) -> None:
        is_first, self.result = self.result is None, outcome
        if not is_first:
            return
        by_me = outcome.outcome == COMPLETED and outcome.by == self.me.name
        why = f": {outcome.why}" if outcome.why else ""
        self._say("done" if by_me else f"{outcome.outcome.lower()} by {outcome.by}{why}")
        self._stop(State.RELEASING)
        self.course.go(State.DONE)
        self._publish()
