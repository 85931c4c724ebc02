"""Panel: the few whose records stand for a large group; pure.

In a small team each that takes part in a task writes a record, and all hear of each: that is n x n messages.  In a
larger one all bid to the council, which costs each of them the same whatever their number, and these alone write: whom
the council announces, who acts or thinks that it is to, and, while there are few records, those whose turn comes.
"""

from __future__ import annotations

import math
from collections.abc import Collection

from middleware.directory.presence import EXECUTING
from middleware.entangled.identity import ID_BYTES
from middleware.entangled.kademlia.distance import distance
from middleware.tasks.task import Member

MOST_OPEN = 12
"""Devices of a team up to which everybody writes."""
SEATS = 8
"""Records of others that are enough, where nothing else asks for one's own: with those announced the panel has some
more.  A group of no more than these all write, whatever the size of the team."""
LISTENING = 0.3
"""Seconds in which a newcomer hears which records there are."""
SPACING = 0.02
"""Seconds between two turns, on the average: five write before the first of them is heard of."""
SETTLING = 1.0
"""Seconds after the last turn within which its record is known to all."""
PAUSE = 1.0
"""Seconds between two records of one member of the panel that differ in nothing that matters at once."""
BELIEVED = 1.0
"""Seconds for which who is announced counts as present, while its record is on its way."""
PATIENCE = 3.0
"""Seconds after the waiting period for which the council's announcement is waited for."""


class Panel:
    """The panel of one task, as the participant ``uuid`` sees it; ``place``, 0 to 1, says how late its turn comes.

    What is heard is told to it; ``due`` says when to write.  Until it has heard of a large team it is one of all.
    """

    def __init__(self, uuid: str, place: float = 0.0) -> None:
        self._uuid = uuid
        self.place = place
        self._devices = 1
        self._is_standing = False
        self._turn_at = self._whole_at = math.inf
        self._announced: dict[str, float] = {}
        self._told: Member | None = None
        self._told_at = -math.inf

    def is_partial(self, now: float) -> bool:
        """Whether the records are those of a panel only: others may take part who wrote none."""
        return self._devices > MOST_OPEN and now < self._whole_at

    def counts(self, now: float) -> bool:
        """Whether this participant is one that the others know of: nobody else is decided for."""
        return not self.is_partial(now) or self.is_written or self._uuid in self._announced

    @property
    def is_written(self) -> bool:
        """Whether a record of this participant stands, or one of its former life."""
        return self._told is not None or self._is_standing

    @property
    def has_word(self) -> bool:
        """Whether the council has announced a bid."""
        return bool(self._announced)

    def heard(self, present: Collection[str], devices: int, now: float) -> None:
        """Take in whose records stand, by their uuids, and how many devices the team has."""
        self._devices = devices
        self._is_standing = self._uuid in present
        if len(present) - self._is_standing >= SEATS:
            self._turn_at = self._whole_at = math.inf
        elif self._turn_at == math.inf:
            begins, lasts = now + LISTENING, SPACING * devices
            self._turn_at = begins + self.place * lasts
            self._whole_at = begins + lasts + SETTLING

    def announced(self, agents: Collection[str], now: float) -> None:
        """Take in whom the council announces."""
        self._announced = {agent: self._announced.get(agent, now) for agent in agents}

    def believes(self, agent: str, now: float) -> bool:
        """Whether ``agent``, of whom there is no record, may still write one because it was announced."""
        return now < self._announced.get(agent, -math.inf) + BELIEVED

    def due(self, me: Member, now: float) -> float:
        """When ``me`` is to be written, as things stand: now, later, or never (infinity)."""
        if me == self._told:
            return math.inf
        if not self.is_partial(now):
            return now
        is_needed = me.uuid in self._announced or me.status == EXECUTING or me.token > 0 or me.assigned == me.uuid
        if self._told is None:
            return now if is_needed or self._is_standing else self._turn_at
        if _urgent(me) != _urgent(self._told):
            return now
        if is_needed or me.assigned != self._told.assigned:
            return self._told_at + PAUSE
        return math.inf

    def wrote(self, me: Member | None, now: float) -> None:
        """Take note that ``me`` is what the record says from now on; None: there is none any more."""
        self._told, self._told_at = me, now


def panel_of(uuid: str, key: bytes) -> Panel:
    """The panel of the task with the group's ``key``, as ``uuid`` sees it.

    The farthest come first: the nearest hold the records, and most of them sit in the council already.
    """
    return Panel(uuid, 1.0 - distance(bytes.fromhex(uuid), key) / (1 << (8 * ID_BYTES)))


def _urgent(member: Member) -> tuple[object, ...]:
    """What of a report the others must know at once: what it does, and whether it can."""
    return member.status, member.token, member.available, member.cost is None, member.assigned == member.uuid
