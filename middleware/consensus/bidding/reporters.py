"""Reporters: the few participants of a large group that write records for all; pure.

In a small team each participant of a task writes a record, and all receive it: n x n messages.  In a larger team all
send their bids to the quorum members, at constant cost per node, and only the reporters write records: the announced
agents, agents that act or expect to, and, while there are few records, others in a staggered order.
"""

from __future__ import annotations

import math
from collections.abc import Collection

from middleware.directory.presence import EXECUTING
from middleware.entangled.identity import ID_BYTES
from middleware.entangled.kademlia.distance import distance
from middleware.tasks.task import Member

MAX_SMALL_TEAM = 12
"""Maximum number of devices of a team in which every participant writes."""
ENOUGH_RECORDS = 8
"""Number of other records that are sufficient.  Announced agents write in addition.

Groups up to this size write all records, whatever the size of the team.
"""
LISTENING_S = 0.3
"""Seconds in which a new participant receives the existing records."""
TURN_SPACING_S = 0.02
"""Average seconds between two turns: five participants write before the first of their records arrives."""
SETTLING_S = 1.0
"""Seconds after the last turn until its record has reached all."""
RECORD_PAUSE_S = 1.0
"""Minimum seconds between two records of one reporter without urgent changes."""
ASSUMED_PRESENT_S = 1.0
"""Seconds for which an announced agent counts as present before its record arrives."""
ANNOUNCEMENT_TIMEOUT_S = 3.0
"""Seconds after the waiting period for which the announcement is awaited."""


class Reporters:
    """The reporters of one task, as the participant ``uuid`` sees them; ``turn_share``, 0 to 1, orders their turns.

    ``compute_due`` returns when to write.  In a small team all participants are reporters.
    """

    def __init__(self, uuid: str, turn_share: float = 0.0) -> None:
        self._uuid = uuid
        self.place = turn_share
        self._devices = 1
        self._is_recorded = False
        self._turn_at = self._complete_at = math.inf
        self._announced: dict[str, float] = {}
        self._written: Member | None = None
        self._written_at = -math.inf

    def is_partial(self, now: float) -> bool:
        """Return whether only reporters have written records, so that there may be other participants."""
        return self._devices > MAX_SMALL_TEAM and now < self._complete_at

    def is_known(self, now: float) -> bool:
        """Return whether the others know this participant; only known agents can be assigned."""
        return not self.is_partial(now) or self.is_written or self._uuid in self._announced

    @property
    def is_written(self) -> bool:
        """Whether there is a record of this participant, possibly from an earlier run."""
        return self._written is not None or self._is_recorded

    @property
    def has_announcement(self) -> bool:
        """Whether the quorum members have announced a bid."""
        return bool(self._announced)

    def on_records(self, present: Collection[str], devices: int, now: float) -> None:
        """Process the uuids with records, and the number of devices in the team."""
        self._devices = devices
        self._is_recorded = self._uuid in present
        if len(present) - self._is_recorded >= ENOUGH_RECORDS:
            self._turn_at = self._complete_at = math.inf
        elif self._turn_at == math.inf:
            begins, lasts = now + LISTENING_S, TURN_SPACING_S * devices
            self._turn_at = begins + self.place * lasts
            self._complete_at = begins + lasts + SETTLING_S

    def on_announcement(self, agents: Collection[str], now: float) -> None:
        """Process the announced agents."""
        self._announced = {agent: self._announced.get(agent, now) for agent in agents}

    def is_assumed_present(self, agent: str, now: float) -> bool:
        """Return whether ``agent`` counts as present without a record, because it was announced recently."""
        return now < self._announced.get(agent, -math.inf) + ASSUMED_PRESENT_S

    def compute_due(self, me: Member, now: float) -> float:
        """Return when the record of ``me`` is to be written: now, later, or never (infinity)."""
        if me == self._written:
            return math.inf
        if not self.is_partial(now):
            return now
        is_needed = me.uuid in self._announced or me.status == EXECUTING or me.token > 0 or me.assigned == me.uuid
        if self._written is None:
            return now if is_needed or self._is_recorded else self._turn_at
        if _urgent_part(me) != _urgent_part(self._written):
            return now
        if is_needed or me.assigned != self._written.assigned:
            return self._written_at + RECORD_PAUSE_S
        return math.inf

    def on_written(self, me: Member | None, now: float) -> None:
        """Record that ``me`` was written; None: the record was removed."""
        self._written, self._written_at = me, now


def make_reporters(uuid: str, key: bytes) -> Reporters:
    """Return the reporters of the task with the group's ``key``, as ``uuid`` sees them.

    The farthest nodes come first: the nearest hold the records, and most of them are quorum members.
    """
    return Reporters(uuid, 1.0 - distance(bytes.fromhex(uuid), key) / (1 << (8 * ID_BYTES)))


def _urgent_part(member: Member) -> tuple[object, ...]:
    """Return the part of a report that the others must know immediately: the agent's activity and availability."""
    return member.status, member.token, member.available, member.cost is None, member.assigned == member.uuid
