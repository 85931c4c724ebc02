"""Epoch: the round of a task that a report or a decision belongs to; pure.

All who take part raise to the highest number heard, as clocks of Lamport do, so a number that was left behind never
comes back.  Whoever is the first to see that a decision has to be taken anew raises it by one; those who come to the
same decision join that round and do not open another.
"""

from __future__ import annotations

from collections.abc import Collection

from middleware.tasks.task import Member

Basis = tuple[object, ...]
"""Everything that a decision depends on: who is present, what they bid, who holds which lease, which task it is."""


class Epoch:
    """The rounds of one task, as one participant counts them."""

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
