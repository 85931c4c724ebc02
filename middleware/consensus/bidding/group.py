"""The group of participants of one task, as one participant sees it: publishes its report and collects all reports.

Thesis, section 4.2.5: agents assigned to the same task write to one part of the DHT and watch it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Set
from typing import TYPE_CHECKING

from twisted.internet.defer import Deferred

from middleware.consensus.bidding.panel import BELIEVED, Panel
from middleware.consensus.strategy import Report
from middleware.consensus.view import View
from middleware.directory.presence import WAITING
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record
from middleware.entangled.replication.owner import Stored
from middleware.tasks.task import DONE, MEMBER, Member, Result, Task, done_packed, group_key, member_of, outcome_of

if TYPE_CHECKING:
    from middleware.consensus.bidding.auctions import Bidding

Heard = Callable[[list[Member], Result | None], None]
"""Called with all present members, including the own one, and the task's outcome (None: it is open)."""

Enter = Callable[[Callable[[tuple[Report, ...]], None]], "Bidding"]
"""Starts bidding; its argument is called with the reports that the quorum members announce."""

Later = Callable[[float, Callable[[], None]], Callable[[], None]]
"""Calls a function after a delay in seconds; returns a function that cancels the call."""


class Roll:
    """The members of one task, merged from two sources; ``view`` is the part of a report that the strategy reads.

    Records under the group's key show the present members; announcements of the quorum members have the best bids.  The
    later report of the two counts.  Absent members do not bid, but an announced bid of a member whose record has not
    arrived yet is kept.
    """

    def __init__(self, view: View | None = None) -> None:
        self._view = view or View()
        self._present: dict[str, Member] = {}
        self._announced: dict[str, Report] = {}
        self._early: set[str] = set()
        self._left: set[str] = set()

    def __len__(self) -> int:
        return len(self._present)

    def present(self, members: Iterable[Member]) -> None:
        """Process the records; a changed report replaces an announced one."""
        before, self._present = self._present, {member.uuid: member for member in members}
        for uuid, member in self._present.items():
            if uuid in before and self._view.report(before[uuid]) != self._view.report(member):
                self._drop_announced(uuid)
        departed = before.keys() - self._present.keys()
        for uuid in departed:
            self._drop_announced(uuid)
        self._left = (self._left | departed) - self._present.keys()

    def announced(self, reports: Iterable[Report]) -> None:
        """Process an announcement; members that it does not name are unchanged.

        Except members that were announced before their records arrived: their records may be newer.
        """
        named = {report.agent: report for report in reports if report.agent not in self._left}
        for uuid in self._early - named.keys():
            self._drop_announced(uuid)
        self._early |= named.keys() - self._present.keys()
        self._announced.update(named)

    def awaited(self) -> list[Report]:
        """Return the announced reports of members whose records have not arrived."""
        return [report for uuid, report in self._announced.items() if uuid not in self._present]

    def uuids(self) -> Set[str]:
        """Return the uuids of the present members."""
        return self._present.keys()

    def members(self) -> list[Member]:
        """Return the present members with their valid reports."""
        return [
            self._view.told(member, self._announced[uuid]) if uuid in self._announced else member
            for uuid, member in self._present.items()
        ]

    def _drop_announced(self, uuid: str) -> None:
        self._announced.pop(uuid, None)
        self._early.discard(uuid)


class Group:
    """One participant's connection to the group of ``task``.

    - ``heard``: called with the members and the outcome after each change
    - ``quietly``: takes writes whose failure is only logged
    - ``ordered``: called with all records, which include an operator's orders
    - ``enter``: starts bidding for the task; None: reports are exchanged by records only
    - ``view``: the part of a report that the strategy reads
    - ``panel``: decides which participants of a team of many ``devices`` write records
    """

    def __init__(
        self,
        task: Task,
        entangled: EntangledNode,
        heard: Heard,
        quietly: Callable[[Deferred[Stored]], None],
        ordered: Callable[[list[Record]], None],
        enter: Enter | None,
        view: View | None,
        panel: Panel,
        devices: Callable[[], int],
        seconds: Callable[[], float],
        later: Later,
    ) -> None:
        self._task = task
        self._key = group_key(task.task_id)
        self._entangled = entangled
        self._heard = heard
        self._ordered = ordered
        self._quietly = quietly
        self._view = view or View()
        self._roll = Roll(self._view)
        self._outcome: Result | None = None
        self._panel = panel
        self._devices = devices
        self._seconds = seconds
        self._later = later
        self._me: Member | None = None
        self._cancel: Callable[[], None] = lambda: None
        self._is_left = False
        panel.heard((), devices(), seconds())
        self._bidding = enter(self._announced) if enter is not None else None
        self._watch = entangled.watch(self._key, self._on_records)

    def report(self, member: Member) -> None:
        """Publish the agent's report; its record is removed when this node leaves."""
        self._me = member
        self._write()
        if self._bidding is None:
            return
        self._bidding.expect(self._expected_bidders())
        report = self._view.report(member)
        if report is not None:
            self._bidding.report(report)
        elif self._bidding.is_standing:  # an agent without a first measurement does not abstain
            self._bidding.withdraw()

    def withdraw(self) -> None:
        """Withdraw this node's report."""
        self._me = None
        if self._panel.is_written:
            self._quietly(self._entangled.remove(self._key, MEMBER))
            self._panel.wrote(None, self._seconds())
        if self._bidding is not None:
            self._bidding.withdraw()

    def conclude(self, result: Result, proof: bytes) -> Deferred[Stored]:
        """Record the outcome with its proof; the record remains when this node leaves."""
        return self._entangled.put(self._key, DONE, done_packed(result, proof), "team")

    def leave(self) -> None:
        """Stop watching the group."""
        self._is_left = True
        self._cancel()
        self._watch.stop()
        if self._bidding is not None:
            self._bidding.leave()

    def _on_records(self, records: list[Record]) -> None:
        self._roll.present(m for record in records if (m := member_of(record)) is not None)
        self._outcome = outcome_of(self._task, records)
        self._panel.heard(self._roll.uuids(), self._devices(), self._seconds())
        if self._bidding is not None:
            self._bidding.expect(self._expected_bidders())
        self._notify()
        self._ordered(records)
        self._write()

    def _announced(self, reports: tuple[Report, ...]) -> None:
        self._roll.announced(reports)
        self._panel.announced([report.agent for report in reports], self._seconds())
        self._notify()
        self._write()
        if self._awaited_members():
            self._later(BELIEVED, self._notify)

    def _notify(self) -> None:
        if not self._is_left:
            self._heard([*self._roll.members(), *self._awaited_members()], self._outcome)

    def _awaited_members(self) -> list[Member]:
        """Return the announced members that are assumed present although their records have not arrived."""
        now = self._seconds()
        if not self._panel.is_partial(now):
            return []
        return [
            self._view.told(Member(report.agent, report.agent[:8], WAITING), report)
            for report in self._roll.awaited()
            if self._panel.believes(report.agent, now)
        ]

    def _expected_bidders(self) -> float:
        """Return the number of bidders after which the quorum members need not wait longer."""
        return math.inf if self._panel.is_partial(self._seconds()) else len(self._roll)

    def _write(self) -> None:
        """Write the record if the panel requires it, or set a timer for later."""
        self._cancel()
        if self._me is None:
            return
        now = self._seconds()
        due = self._panel.due(self._me, now)
        if due <= now:
            self._panel.wrote(self._me, now)
            self._quietly(self._entangled.put(self._key, MEMBER, self._me.packed(), "leased"))
        elif due != math.inf:
            self._cancel = self._later(due - now, self._write)
