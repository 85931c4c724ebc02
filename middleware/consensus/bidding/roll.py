"""Roll: who takes part in a task, and what each of them bids, from two sources; pure.

Records under the group's key say who is present and what people see; the council announces the bids that decide.  The
later word about a member holds, and who is not present bids nothing, whatever was announced.  Who was announced and has
not come yet is kept in mind until it does; who went is gone.
"""

from __future__ import annotations

from collections.abc import Iterable, Set

from middleware.consensus.strategy import Report
from middleware.consensus.view import View
from middleware.tasks.task import Member


class Roll:
    """The members of one task, as one of them sees them; ``view`` is what the task's strategy goes by."""

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
