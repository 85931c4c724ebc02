"""Group: the participants of one task, as one of them sees them; what it reports goes out, what all report comes in.

Thesis, section 4.2.5: agents assigned to the same task write to one part of the DHT and watch it.
"""

from __future__ import annotations

from collections.abc import Callable

from twisted.internet.defer import Deferred

from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record
from middleware.entangled.replication.owner import Stored
from middleware.tasks import MEMBER, RESULT, Member, Result, group_key, member_of, outcome_of

Heard = Callable[[list[Member], Result | None], None]
"""Told of every member that is present, oneself included, and how the task ended (None: it is open)."""


class Group:
    """One participant's place in the group of ``task_id``.

    ``quietly`` takes what may fail without anybody waiting, ``ordered`` all records there are, for an operator's orders
    among them.
    """

    def __init__(
        self,
        task_id: str,
        entangled: EntangledNode,
        heard: Heard,
        quietly: Callable[[Deferred[Stored]], None],
        ordered: Callable[[list[Record]], None] = lambda records: None,
    ) -> None:
        self._key = group_key(task_id)
        self._entangled = entangled
        self._heard = heard
        self._ordered = ordered
        self._quietly = quietly
        self._watch = entangled.watch(self._key, self._changed)

    def report(self, member: Member) -> None:
        """Tell the other participants; gone with this node, should it go."""
        self._quietly(self._entangled.put(self._key, MEMBER, member.packed(), "leased"))

    def withdraw(self) -> None:
        """Take this node's report back."""
        self._quietly(self._entangled.remove(self._key, MEMBER))

    def conclude(self, result: Result) -> Deferred[Stored]:
        """Record how the task ended; stays when this node goes."""
        return self._entangled.put(self._key, RESULT, result.packed(), "team")

    def leave(self) -> None:
        """Hear no more of it."""
        self._watch.stop()

    def _changed(self, records: list[Record]) -> None:
        self._heard([m for record in records if (m := member_of(record)) is not None], outcome_of(records))
        self._ordered(records)
