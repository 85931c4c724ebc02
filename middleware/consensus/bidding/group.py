"""The group of participants of one task at one participant: publish its report and collect the reports of all.

Thesis, section 4.2.5: agents that take part in the same task write under one key of the DHT and watch this key.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Set
from typing import TYPE_CHECKING

from twisted.internet.defer import Deferred

from middleware.consensus.bidding.reporters import ASSUMED_PRESENT_S, Reporters
from middleware.consensus.report_view import ReportView
from middleware.consensus.strategy import Report
from middleware.directory.presence import WAITING
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record
from middleware.entangled.replication.owner import Stored
from middleware.tasks.task import DONE, MEMBER, Member, Result, Task, find_outcome, group_key, pack_done, parse_member

if TYPE_CHECKING:
    from middleware.consensus.bidding.auction_service import Bidding

OnMembers = Callable[[list[Member], Result | None], None]
"""Called with all present members, including this participant, and the task's outcome (None: the task has not
ended)."""

StartBidding = Callable[[Callable[[tuple[Report, ...]], None]], "Bidding"]
"""Starts bidding; its argument is called with the reports that the quorum members announce."""

Later = Callable[[float, Callable[[], None]], Callable[[], None]]
"""Calls a function after a delay in seconds; returns a function that cancels the call."""


class TaskMembers:
    """The members of one task, merged from two sources; ``view`` is the part of a report that the strategy reads.

    A member is present if it has a record under the group's key.  Announcements of the quorum members contain the best
    bids.  Of the two reports of a member, the one that changed last is used.  Bids of absent members are ignored,
    except that an announced bid is kept if the record of its member has not arrived yet.
    """

    def __init__(self, view: ReportView | None = None) -> None:
        self._view = view or ReportView()
        self._present: dict[str, Member] = {}
        self._announced: dict[str, Report] = {}
        self._early: set[str] = set()
        self._left: set[str] = set()

    def __len__(self) -> int:
        return len(self._present)

    def update_present(self, members: Iterable[Member]) -> None:
        """Process the members with records; a changed report in a record replaces an announced report."""
        before, self._present = self._present, {member.uuid: member for member in members}
        for uuid, member in self._present.items():
            if uuid in before and self._view.make_report(before[uuid]) != self._view.make_report(member):
                self._drop_announced(uuid)
        departed = before.keys() - self._present.keys()
        for uuid in departed:
            self._drop_announced(uuid)
        self._left = (self._left | departed) - self._present.keys()

    def update_announced(self, reports: Iterable[Report]) -> None:
        """Process an announcement; the reports of members that are not in it remain unchanged.

        There is one exception: for members that were announced before their records arrived, the records may be newer.
        """
        named = {report.agent: report for report in reports if report.agent not in self._left}
        for uuid in self._early - named.keys():
            self._drop_announced(uuid)
        self._early |= named.keys() - self._present.keys()
        self._announced.update(named)

    def list_awaited(self) -> list[Report]:
        """Return the announced reports of members whose records have not arrived."""
        return [report for uuid, report in self._announced.items() if uuid not in self._present]

    def get_uuids(self) -> Set[str]:
        """Return the uuids of the present members."""
        return self._present.keys()

    def list_members(self) -> list[Member]:
        """Return the present members, each with the report to use."""
        return [
            self._view.apply_report(member, self._announced[uuid]) if uuid in self._announced else member
            for uuid, member in self._present.items()
        ]

    def _drop_announced(self, uuid: str) -> None:
        self._announced.pop(uuid, None)
        self._early.discard(uuid)


class Group:
    """One participant's connection to the group of ``task``.

    - ``on_members``: called with the members and the outcome after each change
    - ``log_failures``: called with the Deferred of each write, to log its failure
    - ``on_orders``: called with all records of the group, which include the orders of operators
    - ``enter``: starts bidding for the task; None: reports are exchanged only as records
    - ``view``: the part of a report that the strategy reads
    - ``reporters``: decides which participants of a team of many ``devices`` write records
    """

    def __init__(
        self,
        task: Task,
        entangled: EntangledNode,
        on_members: OnMembers,
        log_failures: Callable[[Deferred[Stored]], None],
        on_orders: Callable[[list[Record]], None],
        enter: StartBidding | None,
        view: ReportView | None,
        reporters: Reporters,
        devices: Callable[[], int],
        seconds: Callable[[], float],
        later: Later,
    ) -> None:
        self._task = task
        self._key = group_key(task.task_id)
        self._entangled = entangled
        self._on_members = on_members
        self._on_orders = on_orders
        self._log_failures = log_failures
        self._view = view or ReportView()
        self._members = TaskMembers(self._view)
        self._outcome: Result | None = None
        self._reporters = reporters
        self._devices = devices
        self._seconds = seconds
        self._later = later
        self._me: Member | None = None
        self._cancel: Callable[[], None] = lambda: None
        self._has_left = False
        reporters.on_records((), devices(), seconds())
        self._bidding = enter(self._on_announcement) if enter is not None else None
        self._watch = entangled.watch(self._key, self._on_records)

    def report(self, member: Member) -> None:
        """Publish the agent's report; its record is removed when this node leaves."""
        self._me = member
        self._write_record()
        if self._bidding is None:
            return
        self._bidding.expect_bidders(self._count_expected_bidders())
        report = self._view.make_report(member)
        if report is not None:
            self._bidding.report(report)
        elif self._bidding.has_bid:  # an agent without a measurement may bid later, so this is not an abstention
            self._bidding.withdraw()

    def withdraw(self) -> None:
        """Withdraw this node's report."""
        self._me = None
        if self._reporters.is_written:
            self._log_failures(self._entangled.remove(self._key, MEMBER))
            self._reporters.on_written(None, self._seconds())
        if self._bidding is not None:
            self._bidding.withdraw()

    def conclude(self, result: Result, proof: bytes) -> Deferred[Stored]:
        """Record the outcome with the proof of the lease; the record remains when this node leaves."""
        return self._entangled.put(self._key, DONE, pack_done(result, proof), "team")

    def leave(self) -> None:
        """Stop watching the group."""
        self._has_left = True
        self._cancel()
        self._watch.stop()
        if self._bidding is not None:
            self._bidding.leave()

    def _on_records(self, records: list[Record]) -> None:
        self._members.update_present(m for record in records if (m := parse_member(record)) is not None)
        self._outcome = find_outcome(self._task, records)
        self._reporters.on_records(self._members.get_uuids(), self._devices(), self._seconds())
        if self._bidding is not None:
            self._bidding.expect_bidders(self._count_expected_bidders())
        self._notify()
        self._on_orders(records)
        self._write_record()

    def _on_announcement(self, reports: tuple[Report, ...]) -> None:
        self._members.update_announced(reports)
        self._reporters.on_announcement([report.agent for report in reports], self._seconds())
        self._notify()
        self._write_record()
        if self._make_awaited_members():
            self._later(ASSUMED_PRESENT_S, self._notify)

    def _notify(self) -> None:
        if not self._has_left:
            self._on_members([*self._members.list_members(), *self._make_awaited_members()], self._outcome)

    def _make_awaited_members(self) -> list[Member]:
        """Return the announced members that are assumed present although their records have not arrived."""
        now = self._seconds()
        if not self._reporters.is_partial(now):
            return []
        return [
            self._view.apply_report(Member(report.agent, report.agent[:8], WAITING), report)
            for report in self._members.list_awaited()
            if self._reporters.is_assumed_present(report.agent, now)
        ]

    def _count_expected_bidders(self) -> float:
        """Return the number of bidders after which the quorum members need not wait for more."""
        return math.inf if self._reporters.is_partial(self._seconds()) else len(self._members)

    def _write_record(self) -> None:
        """Write this participant's record if it is due, or set a timer for the time at which it will be due."""
        self._cancel()
        if self._me is None:
            return
        now = self._seconds()
        due = self._reporters.compute_due(self._me, now)
        if due <= now:
            self._reporters.on_written(self._me, now)
            self._log_failures(self._entangled.put(self._key, MEMBER, self._me.pack(), "leased"))
        elif due != math.inf:
            self._cancel = self._later(due - now, self._write_record)
