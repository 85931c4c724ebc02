"""Conference: the agents at one task confer: what all have reported, in which round, and who should act; pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from agents.circle import Circle
from agents.decision import Decision, decide
from agents.division import Division
from agents.epoch import Epoch
from middleware.consensus.bidding.panel import Panel
from middleware.consensus.strategy import ConsensusAlgorithm
from middleware.directory.presence import EXECUTING
from middleware.tasks.task import Member, Task


class Conference:
    """One agent's view of it; ``uuid`` is the agent's own, ``division`` that of the task's group, where it has one.

    ``panel`` says whose records stand for all: an agent that is not of it decides as these do, without itself.
    """

    def __init__(self, uuid: str, strategy: ConsensusAlgorithm) -> None:
        self.strategy = strategy
        self.division: Division | None = None
        self.panel = Panel(uuid)
        self._uuid = uuid
        self._circle = Circle(uuid)
        self._epoch = Epoch()
        self._first_report_at: float | None = None
        self._is_new = True

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
        return self.panel.counts(now)

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

    def dismiss(self, uuid: str) -> None:
        """Count what ``uuid`` said for nothing until it says something new."""
        self._circle.dismiss(uuid)

    def decide(self, task: Task, me: Member, now: float) -> Decision:
        """Who should act, of all that have reported (``me`` included)."""
        others = self.others(now)
        members = [me, *others]
        if not any(m.cost is not None for m in members):
            self._first_report_at = None
        elif self._first_report_at is None:
            self._first_report_at = now
        since = None if self._first_report_at is None else now - self._first_report_at
        strategy = self.strategy if self.division is None else self.division.share(task, now, since)
        known = members if self.counts(now) else others
        has_word = self.panel.has_word if self.panel.is_partial(now) else None
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
