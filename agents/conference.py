"""Conference: the agents at one task confer: what all have reported, in which round, and who should act; pure."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

from agents.decision import Decision, decide
from agents.division import Division
from middleware.consensus.bidding.panel import Panel
from middleware.consensus.strategy import ConsensusAlgorithm
from middleware.consensus.verdict import Verdict, verdict_from
from middleware.consensus.view import view_of
from middleware.directory.presence import EXECUTING, IDLE
from middleware.tasks.task import Member, Task, is_bid, is_stale

LINGERING = 3.0
"""Seconds for which a late report of who left is still known to be old."""
Basis = tuple[object, ...]
"""Everything that a decision depends on: who is present, what they bid, who holds which lease, which task it is."""


class Epoch:
    """The rounds of one task, as one participant counts them.

    All participants raise to the highest number heard, as clocks of Lamport do, so a number that was left behind never
    comes back.  The first that sees that a decision has to be taken anew raises it by one; those that come to the same
    decision join that round and do not open another.
    """

    def __init__(self) -> None:
        self.number = 0
        self._basis: Basis | None = None
        self._decided_in = -1

    def hear(self, number: int) -> None:
        """Raise to a number that another has reached."""
        self.number = max(self.number, number)

    def decide(self, basis: Basis, assigned: str, digest: str, others: Collection[Member]) -> int:
        """The round of the decision taken now, which names ``assigned`` from reports with ``digest``."""
        if self._basis is not None and basis != self._basis and self._decided_in >= 0:
            is_open = self.number > self._decided_in and any(
                other.epoch == self.number and other.assigned == assigned and other.digest == digest for other in others
            )
            self.number += not is_open
        self._basis = basis
        if assigned:
            self._decided_in = self.number
        return self.number


def is_older(told: Member, known: Member | None) -> bool:
    """Whether a report was made before one that is known of the same participant, and so says nothing any more."""
    return known is not None and (told.epoch, told.serial) < (known.epoch, known.serial)


class Circle:
    """The participants other than ``uuid``, as their reports tell, which come late, twice and in any order.

    Of each other participant only the newest report counts, for as long as it says, and those that are no longer
    present are forgotten.
    """

    def __init__(self, uuid: str) -> None:
        self._uuid = uuid
        self._known: dict[str, Member] = {}
        self._came: dict[str, float] = {}
        self._left: dict[str, tuple[Member, float]] = {}
        self._dismissed: dict[str, Member] = {}
        self.echo: Member | None = None
        """The newest report of this participant itself that came back: after a restart it is an older life's."""

    def __len__(self) -> int:
        """How many others are present."""
        return len(self._known)

    def hear(self, members: Sequence[Member], now: float) -> None:
        """Take in who is present, and what they report."""
        known: dict[str, Member] = {}
        came: dict[str, float] = {}
        self._left = {uuid: (member, at) for uuid, (member, at) in self._left.items() if now - at < LINGERING}
        for told in members:
            if told.uuid == self._uuid:
                self.echo = told
                continue
            before = known.get(told.uuid, self._known.get(told.uuid))
            if before is None and told.uuid in self._left and is_older(told, self._left[told.uuid][0]):
                continue
            is_news = before is None or (told != before and not is_older(told, before))
            known[told.uuid] = told if is_news or before is None else before
            came[told.uuid] = now if is_news else self._came[told.uuid]
        self._left.update((uuid, (member, now)) for uuid, member in self._known.items() if uuid not in known)
        self._known, self._came = known, came
        self._dismissed = {uuid: was for uuid, was in self._dismissed.items() if known.get(uuid) == was}

    def dismiss(self, uuid: str) -> None:
        """Count what ``uuid`` said for nothing until it says something new: it gave up what it had."""
        if uuid in self._known:
            self._dismissed[uuid] = self._known[uuid]

    def members(self, now: float) -> list[Member]:
        """The others with what counts now, in the order of their uuids: a bid that is none or stale is left out."""
        return [self._sound(self._known[uuid], now) for uuid in sorted(self._known)]

    @property
    def epoch(self) -> int:
        """The highest round that any of them has reached."""
        return max((member.epoch for member in self._known.values()), default=0)

    def _sound(self, member: Member, now: float) -> Member:
        if member.uuid in self._dismissed:
            return replace(member, cost=None, available=False, status=IDLE)
        since = now - self._came[member.uuid]
        is_sound = is_bid(member.cost) and not is_stale(member, since) and math.isfinite(since)
        return member if member.cost is None or is_sound else replace(member, cost=None)


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
