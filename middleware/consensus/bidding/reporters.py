"""Reporters: the few participants of a task in a large team that write records; pure.

In a small team each participant of a task writes a record and receives the records of all others: n x n messages.  In a
larger team all participants send bids to the quorum members, at constant cost per node, and only the reporters write
records.  The reporters are the announced agents, and the agents that act or are about to act.  If there are few
records, other participants also become reporters, one after another.
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
"""If there are this number of records of other participants, a participant need not write its own.  Announced agents
write records in any case.

In groups of up to this size all participants write records, whatever the size of the team.
"""
LISTENING_S = 0.3
"""Seconds for which a new participant waits for the existing records."""
TURN_SPACING_S = 0.02
"""Average seconds between two turns; about five participants write records before the first record arrives."""
SETTLING_S = 1.0
"""Seconds after a turn until the record written in it has reached all participants."""
RECORD_PAUSE_S = 1.0
"""Minimum seconds between two records of one reporter without urgent changes."""
ASSUMED_PRESENT_S = 1.0
"""Seconds for which an announced agent is assumed to be present before its record arrives."""
ANNOUNCEMENT_TIMEOUT_S = 3.0
"""Maximum seconds after the waiting period until the announcement arrives."""


class Reporters:
    """The reporters of one task, as known by the participant ``uuid``.

    Participants take turns, ordered by ``turn_share`` (0 to 1).  ``compute_due`` returns when the participant has to
    write its record.  In a small team all participants are reporters.
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
        """Return whether there may be participants without records, because only reporters write records."""
        return self._devices > MAX_SMALL_TEAM and now < self._complete_at

    def is_known(self, now: float) -> bool:
        """Return whether the other participants know this participant; only known agents can be assigned."""
        return not self.is_partial(now) or self.is_written or self._uuid in self._announced

    @property
    def is_written(self) -> bool:
        """Whether there is a record of this participant, possibly from before its restart."""
        return self._written is not None or self._is_recorded

    @property
    def has_announcement(self) -> bool:
        """Whether the quorum members have announced a bid."""
        return bool(self._announced)

    def on_records(self, present: Collection[str], devices: int, now: float) -> None:
        """Process the uuids of the participants with records, and the number of devices in the team."""
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
        """Return whether ``agent`` is assumed to be present because it was announced recently."""
        return now < self._announced.get(agent, -math.inf) + ASSUMED_PRESENT_S

    def compute_due(self, me: Member, now: float) -> float:
        """Return the time at which the record of ``me`` has to be written; infinity: never."""
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
        """Note that the record of ``me`` was written; None: the record was removed."""
        self._written, self._written_at = me, now


def make_reporters(uuid: str, key: bytes) -> Reporters:
    """Return the reporters of the task with the group key ``key``, as known by the participant ``uuid``.

    The nodes farthest from the key have the first turns, because the nearest nodes already store the records.
    """
    return Reporters(uuid, 1.0 - distance(bytes.fromhex(uuid), key) / (1 << (8 * ID_BYTES)))


def _urgent_part(member: Member) -> tuple[object, ...]:
    """Return the part of a report that is published without delay: the agent's activity and availability."""
    return member.status, member.token, member.available, member.cost is None, member.assigned == member.uuid
