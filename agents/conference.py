"""Conference: the agents at one task confer: what all have reported, in which round, and who should act; pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from agents.account import Account
from agents.circle import Circle
from agents.decision import Decision, decide
from agents.division import Division
from agents.epoch import Epoch
from middleware.consensus.bidding.panel import Panel
from middleware.consensus.strategy import ConsensusAlgorithm
from middleware.consensus.verdict import Verdict
from middleware.directory.presence import EXECUTING
from middleware.tasks.task import Member, Task


class Conference:
    """One agent's view of ``task``; ``uuid`` is the agent's own, ``division`` that of the task's group, if any.

    ``panel`` says whose records stand for all: an agent that is not of it decides as these do, without itself.
    """

    def __init__(self, task: Task, uuid: str, strategy: ConsensusAlgorithm, panel: Panel) -> None:
        self.division: Division | None = None
        self._strategy = strategy
        self._panel = panel
        self._account = Account(task, strategy)
        self._uuid = uuid
        self._circle = Circle(uuid)
        self._epoch = Epoch()
        self._first_report_at: float | None = None
        self._is_new = True
        self._fault = ""

    def __len__(self) -> int:
        """How many others are present."""
        return len(self._circle)

    @property
    def epoch(self) -> int:
        """The round of the task."""
        return self._epoch.number

    def others(self, now: float) -> list[Member]:
        """The others with what counts now."""
        return self._circle.members(now)

    def counts(self, now: float) -> bool:
        """Whether the others know of this agent."""
        return self._panel.counts(now)

    def hear(self, members: Sequence[Member], me: Member, now: float) -> Member:
        """Take in who is present and what they report; the own report ``me``, counted on from where it is known."""
        self._circle.hear(members, now)
        # Who comes is the first to know it: it opens a round, in which nothing that it said in an older life counts.
        self._epoch.hear(self._circle.epoch + (self._is_new and bool(self._circle)))
        self._is_new = self._is_new and not self._circle
        echo = self._circle.echo
        if echo is None or (echo.epoch, echo.serial) <= (me.epoch, me.serial):
            return me
        # An older life of this agent got that far: the others ignore what comes before it.
        self._epoch.hear(echo.epoch)
        return replace(me, epoch=echo.epoch, serial=echo.serial)

    def decide(self, task: Task, me: Member, now: float, is_successor: bool = False) -> Decision:
        """Who should act, of all that have reported (``me`` included).

        An agent that stood by and was given the lease ``is_successor``: the assigned agent has given up, and the news
        of that is on its way, so its reports count for nothing until it sends a new one.
        """
        decision = self._decide(task, me, now)
        for _ in range(len(self) if is_successor else 0):
            if decision.assigned is None or decision.assigned == self._uuid:
                break
            self._circle.dismiss(decision.assigned)
            decision = self._decide(task, me, now)
        return decision

    def new_fault(self, decision: Decision) -> str:
        """The fault of the strategy, unless the decision before had the same; empty without a fault."""
        before, self._fault = self._fault, decision.fault
        return "" if before == decision.fault else decision.fault

    def account(self, decision: Decision, me: Member, token: int, now: float) -> Verdict | None:
        """The verdict on ``decision`` that is due now, if any; ``token`` is that of the lease held, or 0."""
        return self._account.of(decision, me, self.others(now), token, now)

    def _decide(self, task: Task, me: Member, now: float) -> Decision:
        others = self.others(now)
        members = [me, *others]
        if not any(m.cost is not None for m in members):
            self._first_report_at = None
        elif self._first_report_at is None:
            self._first_report_at = now
        since = None if self._first_report_at is None else now - self._first_report_at
        strategy = self._strategy if self.division is None else self.division.share(task, now, since)
        known = members if self.counts(now) else others
        has_word = self._panel.has_word if self._panel.is_partial(now) else None
        decision = decide(known, strategy, task.hysteresis, task.waiting_period, since, has_word)
        basis = (*decision.basis, task.generation, task.configuration)
        self._epoch.decide(basis, decision.assigned or "", decision.digest, others)
        return decision

    def is_first(self, now: float) -> bool:
        """Whether it falls to this agent to say what all know: nobody acts, and no uuid here is lower."""
        others = self.others(now)
        return (
            self.counts(now)
            and not any(m.status == EXECUTING for m in others)
            and all(self._uuid < m.uuid for m in others)
        )
