"""Group: the participants of one task, as one of them sees them; what it reports goes out, what all report comes in.

Thesis, section 4.2.5: agents assigned to the same task write to one part of the DHT and watch it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from twisted.internet.defer import Deferred

from middleware.consensus.strategy import Report
from middleware.consensus.view import View
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record
from middleware.entangled.replication.owner import Stored
from middleware.tasks import MEMBER, RESULT, Member, Result, group_key, member_of, outcome_of

if TYPE_CHECKING:
    from middleware.dissemination.bidding import Bidding

Heard = Callable[[list[Member], Result | None], None]
"""Told of every member that is present, oneself included, and how the task ended (None: it is open)."""

Enter = Callable[[Callable[[tuple[Report, ...]], None]], "Bidding"]
"""Begins to bid, given what is to be told of the bids that the council announces."""


class Group:
    """One participant's place in the group of ``task_id``.

    ``quietly`` takes what may fail without anybody waiting, ``ordered`` all records there are, for an operator's orders
    among them.  With ``enter`` bids go to the task's council as well (``dissemination``), which announces those that
    decide; the records stay as what people see, and as who is present.  ``view`` is what the task's strategy goes by.
    """

    def __init__(
        self,
        task_id: str,
        entangled: EntangledNode,
        heard: Heard,
        quietly: Callable[[Deferred[Stored]], None],
        ordered: Callable[[list[Record]], None] = lambda records: None,
        enter: Enter | None = None,
        view: View | None = None,
    ) -> None:
        self._key = group_key(task_id)
        self._entangled = entangled
        self._heard = heard
        self._ordered = ordered
        self._quietly = quietly
        # Imported by the first who takes part: a plain node has no group.
        from middleware.dissemination.roll import Roll

        self._view = view or View()
        self._roll = Roll(self._view)
        self._outcome: Result | None = None
        self._bidding = enter(self._announced) if enter is not None else None
        self._watch = entangled.watch(self._key, self._changed)

    def report(self, member: Member) -> None:
        """Tell the other participants; gone with this node, should it go."""
        self._quietly(self._entangled.put(self._key, MEMBER, member.packed(), "leased"))
        if self._bidding is None:
            return
        report = self._view.report(member)
        if report is not None:
            self._bidding.report(report)
        elif self._bidding.is_standing:  # who has not measured anything yet does not abstain
            self._bidding.withdraw()

    def withdraw(self) -> None:
        """Take this node's report back."""
        self._quietly(self._entangled.remove(self._key, MEMBER))
        if self._bidding is not None:
            self._bidding.withdraw()

    def conclude(self, result: Result) -> Deferred[Stored]:
        """Record how the task ended; stays when this node goes."""
        return self._entangled.put(self._key, RESULT, result.packed(), "team")

    def leave(self) -> None:
        """Hear no more of it."""
        self._watch.stop()
        if self._bidding is not None:
            self._bidding.leave()

    def _changed(self, records: list[Record]) -> None:
        self._roll.present(m for record in records if (m := member_of(record)) is not None)
        self._outcome = outcome_of(records)
        if self._bidding is not None:
            self._bidding.expect(len(self._roll))
        self._heard(self._roll.members(), self._outcome)
        self._ordered(records)

    def _announced(self, reports: tuple[Report, ...]) -> None:
        self._roll.announced(reports)
        self._heard(self._roll.members(), self._outcome)
