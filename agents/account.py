"""Account: when an agent says why it decided so: at each new decision, and seldom where only reports moved; pure."""

from __future__ import annotations

from collections.abc import Sequence

from agents.decision import Decision
from middleware.consensus.strategy import ConsensusAlgorithm
from middleware.consensus.verdict import Verdict, verdict_from
from middleware.consensus.view import view_of
from middleware.directory.presence import EXECUTING
from middleware.tasks.task import Member, Task

PAUSE = 1.0
"""Seconds between two accounts of a decision of which nothing changed but the reports."""


class Account:
    """One agent's accounts of its decisions about ``task``."""

    def __init__(self, task: Task, strategy: ConsensusAlgorithm) -> None:
        self._task = task
        self._strategy = strategy
        self._token = 0
        self._judged: tuple[object, ...] = ()
        self._given_at = 0.0

    def of(self, decision: Decision, me: Member, others: Sequence[Member], token: int, now: float) -> Verdict | None:
        """The verdict that is due now, if any; ``token`` is that of the lease which this agent holds, or 0."""
        members = [me, *others]
        tokens = [m.token for m in members if m.status == EXECUTING]
        self._token = max(self._token, *(m.token for m in members))
        # The epoch is the token under which the task is done, or is to be done next.
        epoch = max(tokens, default=self._token + 1)
        judged = (epoch, decision.assigned, token, len(members), decision.digest)
        is_new, is_due = judged[:-1] != self._judged[:-1], now - self._given_at >= PAUSE
        if judged == self._judged or not (is_new or is_due) or not (decision.assigned or self._judged):
            return None
        self._judged = judged
        if decision.consensus is None:
            return None
        self._given_at = now
        rule = decision.consensus.strategy or self._strategy.name
        version = str(getattr(self._strategy, "version", "")) if rule == self._strategy.name else ""
        given = (self._task.task_id, epoch, me, others, rule, version)
        found, view = decision.consensus, view_of(self._strategy)
        verdict = verdict_from(*given, found, decision.assigned, self._task.hysteresis, token, view)
        return verdict if verdict.is_witness else None
