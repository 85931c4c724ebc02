"""Group: the participants of one task, as one of them sees them; what it reports goes out, what all report comes in.

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
"""Told of every member that is present, oneself included, and how the task ended (None: it is open)."""

Enter = Callable[[Callable[[tuple[Report, ...]], None]], "Bidding"]
"""Begins to bid, given what is to be told of the bids that the council announces."""

Later = Callable[[float, Callable[[], None]], Callable[[], None]]
"""Calls after so many seconds; calling what it returns prevents that."""


class Roll:
    """The members of one task, as one of them sees them, from two sources; ``view`` is what the strategy goes by.

    Records under the group's key say who is present; the council announces the bids that decide.  The later of the two
    counts.  A member that is not present bids nothing, whatever was announced; what was announced of one that has not
    come yet is kept until it comes.
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
        """Take what the records say now; where a report is another than before, it is the later word."""
        before, self._present = self._present, {member.uuid: member for member in members}
        for uuid, member in self._present.items():
            if uuid in before and self._view.report(before[uuid]) != self._view.report(member):
                self._forget(uuid)
        gone = before.keys() - self._present.keys()
        for uuid in gone:
            self._forget(uuid)
        self._left = (self._left | gone) - self._present.keys()

    def announced(self, reports: Iterable[Report]) -> None:
        """Take what the council announces; whom it does not name, it says nothing about.

        Except those of whom it spoke before their records came: what these say may be later.
        """
        named = {report.agent: report for report in reports if report.agent not in self._left}
        for uuid in self._early - named.keys():
            self._forget(uuid)
        self._early |= named.keys() - self._present.keys()
        self._announced.update(named)

    def awaited(self) -> list[Report]:
        """What was announced of those who have not come yet."""
        return [report for uuid, report in self._announced.items() if uuid not in self._present]

    def uuids(self) -> Set[str]:
        """Who is present."""
        return self._present.keys()

    def members(self) -> list[Member]:
        """Everybody that is present, with the bid that counts."""
        return [
            self._view.told(member, self._announced[uuid]) if uuid in self._announced else member
            for uuid, member in self._present.items()
        ]

    def _forget(self, uuid: str) -> None:
        self._announced.pop(uuid, None)
        self._early.discard(uuid)


class Group:
    """One participant's place in the group of ``task``.

    ``quietly`` takes what may fail without anybody waiting, ``ordered`` all records there are, for an operator's orders
    among them.  With ``enter`` bids go to the task's council as well (``dissemination``), which announces those that
    decide; the records stay as what people see, and as who is present.  ``view`` is what the task's strategy goes by.

    Of a team of many ``devices`` only the ``panel`` writes records.
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
        self._watch = entangled.watch(self._key, self._changed)

    def report(self, member: Member) -> None:
        """Tell the other participants; gone with this node, should it go."""
        self._me = member
        self._write()
        if self._bidding is None:
            return
        self._bidding.expect(self._expected())
        report = self._view.report(member)
        if report is not None:
            self._bidding.report(report)
        elif self._bidding.is_standing:  # who has not measured anything yet does not abstain
            self._bidding.withdraw()

    def withdraw(self) -> None:
        """Take this node's report back."""
        self._me = None
        if self._panel.is_written:
            self._quietly(self._entangled.remove(self._key, MEMBER))
            self._panel.wrote(None, self._seconds())
        if self._bidding is not None:
            self._bidding.withdraw()

    def conclude(self, result: Result, proof: bytes) -> Deferred[Stored]:
        """Record how the task ended, with the proof of its council; stays when this node goes."""
        return self._entangled.put(self._key, DONE, done_packed(result, proof), "team")

    def leave(self) -> None:
        """Hear no more of it."""
        self._is_left = True
        self._cancel()
        self._watch.stop()
        if self._bidding is not None:
            self._bidding.leave()

    def _changed(self, records: list[Record]) -> None:
        self._roll.present(m for record in records if (m := member_of(record)) is not None)
        self._outcome = outcome_of(self._task, records)
        self._panel.heard(self._roll.uuids(), self._devices(), self._seconds())
        if self._bidding is not None:
            self._bidding.expect(self._expected())
        self._tell()
        self._ordered(records)
        self._write()

    def _announced(self, reports: tuple[Report, ...]) -> None:
        self._roll.announced(reports)
        self._panel.announced([report.agent for report in reports], self._seconds())
        self._tell()
        self._write()
        if self._awaited():
            self._later(BELIEVED, self._tell)

    def _tell(self) -> None:
        if not self._is_left:
            self._heard([*self._roll.members(), *self._awaited()], self._outcome)

    def _awaited(self) -> list[Member]:
        """Who was announced and is believed to be here: its record is on its way."""
        now = self._seconds()
        if not self._panel.is_partial(now):
            return []
        return [
            self._view.told(Member(report.agent, report.agent[:8], WAITING), report)
            for report in self._roll.awaited()
            if self._panel.believes(report.agent, now)
        ]

    def _expected(self) -> float:
        """How many are to bid until the council need not wait any longer."""
        return math.inf if self._panel.is_partial(self._seconds()) else len(self._roll)

    def _write(self) -> None:
        """Write the record, where the panel has use for it, or look again when it may."""
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
