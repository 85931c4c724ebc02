"""Engagement: one agent's part in one task, from assignment to end (Algorithm 4.5, revised).

Selection and commitment are two things here: ``decide`` says who should act, the lease who may.  Nothing is executed
without a lease that is valid now; when the decision or the lease goes elsewhere, the body stops first and the lease is
given back after.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from twisted.internet.interfaces import IReactorTime

from agents.behaviour import STAND, Behaviour
from agents.decision import Decision, decide
from drivers.driver import Permit
from drivers.reading import Action, Observation
from middleware.consensus.lease import Lessee
from middleware.consensus.strategy import ConsensusAlgorithm, Report
from middleware.presence import ASSIGNED, DONE, EXECUTING, SEARCHING, WAITING
from middleware.tasks import COMPLETED, Member, Result, Task
from middleware.verdict import Verdict, verdict_from

FARTHER, NEARER, STEP = 1.15, 0.85, 0.05
"""A report is renewed when the distance grew by 15 % and 5 cm (the target was moved), or shrank so much while the body
does not act."""
SEARCH_TTL = 0.5
"""Seconds for which a motion that needs no lease (to look around) is allowed at a time."""

JUSTIFY = 1.0
"""Seconds between two accounts of a decision of which nothing changed but the reports."""


@dataclass(frozen=True)
class Deed:
    """What the body is to do, and the permit under which it may."""

    action: Action
    permit: Permit


class Engagement:
    """One agent at one task.

    ``tell`` publishes this agent's report; ``conclude`` records the outcome; ``say`` writes a line for people; ``halt``
    stops the body now; ``token`` is the highest token that the body has obeyed so far.  ``lessee`` is to be set before
    the first step; ``justify`` is told why, at each decision.
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
        halt: Callable[[], object],
    ) -> None:
        self.task = task
        self.me = replace(me, status=ASSIGNED)
        self.result: Result | None = None
        self.token = token
        self.lessee: Lessee | None = None
        self.justify: Callable[[Verdict], None] = lambda verdict: None
        self._behaviour = behaviour
        self._strategy = strategy
        self._clock = clock
        self._tell = tell
        self._conclude = conclude
        self._say = say
        self._halt = halt
        self._others: dict[str, Member] = {}
        self._first_report_at: float | None = None
        self._began = clock.seconds()
        self._acting = False
        self._concluding = False
        self._seen_token = 0
        self._judged: tuple[object, ...] = ()
        self._justified_at = 0.0

    @property
    def is_over(self) -> bool:
        """Whether the task has an outcome."""
        return self.result is not None

    def heard(self, members: list[Member], outcome: Result | None) -> None:
        """Take in who is present and what they report, and how the task ended."""
        if outcome is not None and self.result is None:
            self._end(outcome)
        self._others = {m.uuid: m for m in members if m.uuid != self.me.uuid}

    def look(self, seen: Observation) -> None:
        """Take in what the body senses, and report when it is new to the others."""
        self._behaviour.look(seen, self._clock.seconds())
        cost = self._behaviour.cost
        known = self.me.cost
        if cost is None or known is None:
            news = (cost is None) != (known is None)
        else:
            news = cost > known * FARTHER + STEP or (not self._acting and cost < known * NEARER - STEP)
        if news:
            self._say("lost sight of it" if cost is None else f"reports {cost:.2f} m")
            self._publish(cost=cost)

    def lose_body(self) -> None:
        """Take the report back: the body does not answer, so another has to act.  The next look reports again."""
        if self.me.cost is not None and not self.is_over:
            self._say("has lost its robot")
            self._publish(cost=None)

    def step(self) -> Deed | None:
        """Decide again and say what to do now; None where the task is over."""
        if self.is_over or self._concluding:
            return None
        now = self._clock.seconds()
        decision = self._decision(now)
        mine = decision.assigned == self.me.uuid
        if not mine:
            self._give_back()
            return self._stand_by(decision, now)
        assert self.lessee is not None
        self.lessee.want()
        lease = self.lessee.lease
        if lease is None:
            self._rest()
            return self._stand_by(decision, now)
        if not self._acting:
            self._acting = True
            self._say(f"goes: {decision.why}")
        self.token = max(self.token, lease.token)
        self._publish_decision(EXECUTING, decision, lease.token)
        action = self._behaviour.execute(now)
        if action is None:
            self._complete(lease.token)
            return Deed(STAND, Permit(lease.token, lease.deadline))
        return Deed(action, Permit(lease.token, lease.deadline))

    def abandon(self) -> None:
        """Leave the task: the lease is given back (the caller has stopped the body)."""
        if self.lessee is not None:
            self.lessee.release()

    # -- inside -----------------------------------------------------------------------------------------------------

    def _decision(self, now: float) -> Decision:
        members = [self.me, *self._others.values()]
        if not any(m.cost is not None for m in members):
            self._first_report_at = None
        elif self._first_report_at is None:
            self._first_report_at = now
        since = None if self._first_report_at is None else now - self._first_report_at
        return decide(members, self._strategy, self.task.hysteresis, self.task.waiting_period, since)

    def _stand_by(self, decision: Decision, now: float) -> Deed:
        searching = self.me.cost is None
        status = SEARCHING if searching else WAITING
        self._publish_decision(status, decision, 0)
        action = self._behaviour.search(now) if searching else self._behaviour.hold(now)
        return Deed(action, Permit(self.token, now + SEARCH_TTL))

    def _publish_decision(self, status: str, decision: Decision, token: int) -> None:
        assigned = decision.assigned or ""
        if assigned and assigned != self.me.assigned and assigned != self.me.uuid:
            self._say(f"stands by: {decision.why}")
        self._publish(status=status, assigned=assigned, digest=decision.digest, token=token, why=decision.why)
        self._account(decision, token)

    def _account(self, decision: Decision, token: int) -> None:
        """Say why, at each new decision; where only the reports moved, once in ``JUSTIFY`` seconds."""
        members = [self.me, *self._others.values()]
        tokens = [m.token for m in members if m.status == EXECUTING]
        self._seen_token = max(self._seen_token, *(m.token for m in members))
        # The epoch is the token under which the task is done, or is to be done next.
        epoch = max(tokens, default=self._seen_token + 1)
        now, judged = self._clock.seconds(), (epoch, decision.assigned, token, len(members), decision.digest)
        is_new, is_due = judged[:-1] != self._judged[:-1], now - self._justified_at >= JUSTIFY
        if judged == self._judged or not (is_new or is_due) or not (decision.assigned or self._judged):
            return
        self._judged, self._justified_at = judged, now
        consensus = self._strategy.find([Report(m.uuid, m.cost) for m in members if m.cost is not None])
        version = str(getattr(self._strategy, "version", ""))
        given = (self.task.task_id, epoch, self.me, self._others.values(), self.task.strategy, version)
        verdict = verdict_from(*given, consensus, decision.assigned, self.task.hysteresis, token)
        if verdict.is_witness:
            self.justify(verdict)

    def _publish(self, **changes: object) -> None:
        told = replace(self.me, **changes)  # type: ignore[arg-type]
        if told != self.me:
            self.me = told
            self._tell(told)

    def _give_back(self) -> None:
        if self._rest():
            self._say("gives the task back")
        if self.lessee is not None:
            self.lessee.release()

    def _rest(self) -> bool:
        """Stop the body where it acts; whether it did."""
        was_acting, self._acting = self._acting, False
        if was_acting:
            self._halt()
        return was_acting

    def _complete(self, token: int) -> None:
        """Record the outcome; the lease is kept until the outcome is known, so that nobody starts over in between."""
        self._concluding = True
        self._halt()
        bids = sorted((m.name, m.cost) for m in [self.me, *self._others.values()] if m.cost is not None)
        took = round(self._clock.seconds() - self._began, 2)
        self._conclude(Result(COMPLETED, self.me.name, took, token, tuple(bids)))

    def _end(self, outcome: Result) -> None:
        self.result = outcome
        by_me = outcome.outcome == COMPLETED and outcome.by == self.me.name
        self._say("done" if by_me else f"{outcome.outcome.lower()} by {outcome.by}")
        self._rest()
        self._publish(status=DONE)
