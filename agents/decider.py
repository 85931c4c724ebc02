"""The agents at one task: their reports, the round of the decision, and the decision itself; pure."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

from agents.decision import Decision, decide
from agents.task_group import TaskGroup
from middleware.consensus.bidding.reporters import Reporters
from middleware.consensus.decision_record import DecisionRecord, make_decision_record
from middleware.consensus.report_view import make_view
from middleware.consensus.strategy import ConsensusAlgorithm
from middleware.directory.presence import EXECUTING, IDLE
from middleware.tasks.task import Member, Task, is_bid, is_stale

DEPARTED_MEMORY_S = 3.0
"""Seconds for which a late report of a departed agent is recognised as old."""
Basis = tuple[object, ...]
"""All inputs of a decision: the present members, their bids, the leases, and the task."""


class RoundCounter:
    """The round counter of one task at one participant.

    All participants raise their counter to the highest number received, as Lamport clocks do, so no round number is
    used twice. The first participant that has to decide again starts a new round; participants with the same decision
    join that round.
    """

    def __init__(self) -> None:
        self.number = 0
        self._basis: Basis | None = None
        self._decided_in = -1

    def advance(self, number: int) -> None:
        """Raise the counter to a number received from another participant."""
        self.number = max(self.number, number)

    def determine_round(self, basis: Basis, assigned: str, digest: str, others: Collection[Member]) -> int:
        """Return the round of a decision that assigns ``assigned`` from reports with ``digest``."""
        if self._basis is not None and basis != self._basis and self._decided_in >= 0:
            is_open = self.number > self._decided_in and any(
                other.epoch == self.number and other.assigned == assigned and other.digest == digest for other in others
            )
            self.number += not is_open
        self._basis = basis
        if assigned:
            self._decided_in = self.number
        return self.number


def is_older(report: Member, known: Member | None) -> bool:
    """Return whether ``report`` is older than the known report of the same participant."""
    return known is not None and (report.epoch, report.serial) < (known.epoch, known.serial)


class PeerReports:
    """The reports of all participants except ``uuid``; reports may arrive late, twice and in any order.

    Only the newest report of each participant is used, until it expires; departed participants are removed.
    """

    def __init__(self, uuid: str) -> None:
        self._uuid = uuid
        self._reports: dict[str, Member] = {}
        self._arrived_at: dict[str, float] = {}
        self._departed: dict[str, tuple[Member, float]] = {}
        self._ignored: dict[str, Member] = {}
        self.own_report: Member | None = None
        """This participant's own newest report as received from the group; after a restart it is from the previous
        run."""

    def __len__(self) -> int:
        """Return the number of other participants."""
        return len(self._reports)

    def update(self, members: Sequence[Member], now: float) -> None:
        """Process the list of present participants and their reports."""
        known: dict[str, Member] = {}
        arrived_at: dict[str, float] = {}
        self._departed = {
            uuid: (member, at) for uuid, (member, at) in self._departed.items() if now - at < DEPARTED_MEMORY_S
        }
        for report in members:
            if report.uuid == self._uuid:
                self.own_report = report
                continue
            before = known.get(report.uuid, self._reports.get(report.uuid))
            if before is None and report.uuid in self._departed and is_older(report, self._departed[report.uuid][0]):
                continue
            is_news = before is None or (report != before and not is_older(report, before))
            known[report.uuid] = report if is_news or before is None else before
            arrived_at[report.uuid] = now if is_news else self._arrived_at[report.uuid]
        self._departed.update((uuid, (member, now)) for uuid, member in self._reports.items() if uuid not in known)
        self._reports, self._arrived_at = known, arrived_at
        self._ignored = {uuid: was for uuid, was in self._ignored.items() if known.get(uuid) == was}

    def ignore_report(self, uuid: str) -> None:
        """Ignore the last report of ``uuid``, which has given up the task, until its next report arrives."""
        if uuid in self._reports:
            self._ignored[uuid] = self._reports[uuid]

    def members(self, now: float) -> list[Member]:
        """Return the other participants, sorted by uuid, with invalid and expired costs removed."""
        return [self._valid_report(self._reports[uuid], now) for uuid in sorted(self._reports)]

    @property
    def epoch(self) -> int:
        """The highest round of any other participant."""
        return max((member.epoch for member in self._reports.values()), default=0)

    def _valid_report(self, member: Member, now: float) -> Member:
        if member.uuid in self._ignored:
            return replace(member, cost=None, available=False, status=IDLE)
        since = now - self._arrived_at[member.uuid]
        is_sound = is_bid(member.cost) and not is_stale(member, since) and math.isfinite(since)
        return member if member.cost is None or is_sound else replace(member, cost=None)


MIN_RECORD_INTERVAL_S = 1.0
"""Minimum seconds between two records of a decision in which only the reports changed."""


class DecisionRecorder:
    """One agent's records of its decisions about ``task``."""

    def __init__(self, task: Task, strategy: ConsensusAlgorithm) -> None:
        self._task = task
        self._strategy = strategy
        self._token = 0
        self._recorded: tuple[object, ...] = ()
        self._recorded_at = 0.0

    def make_record(
        self, decision: Decision, me: Member, others: Sequence[Member], token: int, now: float
    ) -> DecisionRecord | None:
        """Return the decision record that is due now, or None; ``token`` is the fencing token of a held lease, or 0."""
        members = [me, *others]
        tokens = [m.token for m in members if m.status == EXECUTING]
        self._token = max(self._token, *(m.token for m in members))
        # The epoch is the token under which the task is executed now or will be executed next.
        epoch = max(tokens, default=self._token + 1)
        state_key = (epoch, decision.assigned, token, len(members), decision.digest)
        is_new, is_due = state_key[:-1] != self._recorded[:-1], now - self._recorded_at >= MIN_RECORD_INTERVAL_S
        if state_key == self._recorded or not (is_new or is_due) or not (decision.assigned or self._recorded):
            return None
        self._recorded = state_key
        if decision.consensus is None:
            return None
        self._recorded_at = now
        rule = decision.consensus.strategy or self._strategy.name
        version = str(getattr(self._strategy, "version", "")) if rule == self._strategy.name else ""
        identification = (self._task.task_id, epoch, me, others, rule, version)
        found, view = decision.consensus, make_view(self._strategy)
        record = make_decision_record(*identification, found, decision.assigned, self._task.hysteresis, token, view)
        return record if record.is_publisher else None


class Decider:
    """One agent's view of ``task``.

    ``uuid`` is the uuid of this agent, ``task_group`` the task's group or None. ``reporters`` are the reporters of a
    large team; an agent that is not a reporter decides from the reports of the reporters only.
    """

    def __init__(self, task: Task, uuid: str, strategy: ConsensusAlgorithm, reporters: Reporters) -> None:
        self.task_group: TaskGroup | None = None
        self._strategy = strategy
        self._panel = reporters
        self._recorder = DecisionRecorder(task, strategy)
        self._uuid = uuid
        self._peers = PeerReports(uuid)
        self._round_counter = RoundCounter()
        self._first_report_at: float | None = None
        self._is_new = True
        self._fault = ""

    def __len__(self) -> int:
        """Return the number of other participants."""
        return len(self._peers)

    @property
    def epoch(self) -> int:
        """The round of the task."""
        return self._round_counter.number

    def others(self, now: float) -> list[Member]:
        """Return the other participants with their valid reports."""
        return self._peers.members(now)

    def is_report_visible(self, now: float) -> bool:
        """Return whether this agent's report is visible to the other agents."""
        return self._panel.is_known(now)

    def update_reports(self, members: Sequence[Member], me: Member, now: float) -> Member:
        """Process the present members and their reports; return ``me`` with advanced counters if necessary."""
        self._peers.update(members, now)
        # A new participant starts a round, so that its reports from an earlier run are ignored.
        self._round_counter.advance(self._peers.epoch + (self._is_new and bool(self._peers)))
        self._is_new = self._is_new and not self._peers
        echo = self._peers.own_report
        if echo is None or (echo.epoch, echo.serial) <= (me.epoch, me.serial):
            return me
        # An earlier run of this agent reached a higher count; the other agents ignore reports with lower counts.
        self._round_counter.advance(echo.epoch)
        return replace(me, epoch=echo.epoch, serial=echo.serial)

    def decide(self, task: Task, me: Member, now: float, is_successor: bool = False) -> Decision:
        """Decide from all reports, including ``me``.

        ``is_successor`` is True for a standby that was granted the lease. The assigned agent has then given up the
        task, but its notice has not arrived yet; its reports are ignored until the next one arrives.
        """
        decision = self._decide(task, me, now)
        for _ in range(len(self) if is_successor else 0):
            if decision.assigned is None or decision.assigned == self._uuid:
                break
            self._peers.ignore_report(decision.assigned)
            decision = self._decide(task, me, now)
        return decision

    def get_new_fault(self, decision: Decision) -> str:
        """Return the strategy's fault if it differs from the previous decision's, otherwise ""."""
        before, self._fault = self._fault, decision.fault
        return "" if before == decision.fault else decision.fault

    def make_record(self, decision: Decision, me: Member, token: int, now: float) -> DecisionRecord | None:
        """Return the record of ``decision`` that is due now, or None.

        ``token`` is the fencing token of a held lease, or 0.
        """
        return self._recorder.make_record(decision, me, self.others(now), token, now)

    def _decide(self, task: Task, me: Member, now: float) -> Decision:
        others = self.others(now)
        members = [me, *others]
        if not any(m.cost is not None for m in members):
            self._first_report_at = None
        elif self._first_report_at is None:
            self._first_report_at = now
        since = None if self._first_report_at is None else now - self._first_report_at
        strategy = self._strategy if self.task_group is None else self.task_group.make_strategy(task, now, since)
        known = members if self.is_report_visible(now) else others
        has_word = self._panel.has_announcement if self._panel.is_partial(now) else None
        decision = decide(known, strategy, task.hysteresis, task.waiting_period, since, has_word)
        basis = (*decision.basis, task.generation, task.configuration)
        self._round_counter.determine_round(basis, decision.assigned or "", decision.digest, others)
        return decision

    def is_first(self, now: float) -> bool:
        """Return whether this agent does the group's duties: no agent executes the task and its uuid is the lowest."""
        others = self.others(now)
        return (
            self.is_report_visible(now)
            and not any(m.status == EXECUTING for m in others)
            and all(self._uuid < m.uuid for m in others)
        )
