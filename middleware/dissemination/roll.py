"""Roll: who takes part in a task, and what each of them bids, from two sources; pure.

Records under the group's key say who is present and what people see; the council announces the bids that decide.  The
later word about a member holds, and who is not present bids nothing, whatever was announced.
"""

from __future__ import annotations

from collections.abc import Iterable

from middleware.consensus.strategy import Report
from middleware.consensus.view import View
from middleware.tasks import Member


class Roll:
    """The members of one task, as one of them sees them; ``view`` is what the task's strategy goes by."""

    def __init__(self, view: View | None = None) -> None:
        self._view = view or View()
        self._present: dict[str, Member] = {}
        self._announced: dict[str, Report] = {}

    def __len__(self) -> int:
        return len(self._present)

    def present(self, members: Iterable[Member]) -> None:
        """Take what the records say now; where a report is another than before, it is the later word."""
        before, self._present = self._present, {member.uuid: member for member in members}
        for uuid, member in self._present.items():
            if uuid not in before or self._view.report(before[uuid]) != self._view.report(member):
                self._announced.pop(uuid, None)
        for uuid in [uuid for uuid in self._announced if uuid not in self._present]:
            del self._announced[uuid]

    def announced(self, reports: Iterable[Report]) -> None:
        """Take what the council announces; whom it does not name, it says nothing about."""
        self._announced.update((r.agent, r) for r in reports if r.agent in self._present)

    def members(self) -> list[Member]:
        """Everybody that is present, with the bid that counts."""
        return [
            self._view.told(member, self._announced[uuid]) if uuid in self._announced else member
            for uuid, member in self._present.items()
        ]
