"""Circle: the others at one task, as one participant has heard of them; pure.

Reports come late, twice and in any order.  Of each other only the newest counts, for as long as it says, and those
that are no longer present are forgotten.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from agents.epoch import is_older
from middleware.directory.presence import IDLE
from middleware.tasks.task import Member, is_bid, is_stale

LINGERING = 3.0
"""Seconds for which a late report of who left is still known to be old."""


class Circle:
    """The participants other than ``uuid``."""

    def __init__(self, uuid: str) -> None:
        self._uuid = uuid
        self._known: dict[str, Member] = {}
        self._came: dict[str, float] = {}
        self._left: dict[str, tuple[Member, float]] = {}
        self._dismissed: dict[str, Member] = {}
        self.echo: Member | None = None
        """The newest report of this participant itself that came back: after a restart it is an older life's."""

    def __len__(self) -> int:
        """How many others are present."""
        return len(self._known)

    def hear(self, members: Sequence[Member], now: float) -> None:
        """Take in who is present, and what they report."""
        known: dict[str, Member] = {}
        came: dict[str, float] = {}
        self._left = {uuid: (member, at) for uuid, (member, at) in self._left.items() if now - at < LINGERING}
        for told in members:
            if told.uuid == self._uuid:
                self.echo = told
                continue
            before = known.get(told.uuid, self._known.get(told.uuid))
            if before is None and told.uuid in self._left and is_older(told, self._left[told.uuid][0]):
                continue
            is_news = before is None or (told != before and not is_older(told, before))
            known[told.uuid] = told if is_news or before is None else before
            came[told.uuid] = now if is_news else self._came[told.uuid]
        self._left.update((uuid, (member, now)) for uuid, member in self._known.items() if uuid not in known)
        self._known, self._came = known, came
        self._dismissed = {uuid: was for uuid, was in self._dismissed.items() if known.get(uuid) == was}

    def dismiss(self, uuid: str) -> None:
        """Count what ``uuid`` said for nothing until it says something new: it gave up what it had."""
        if uuid in self._known:
            self._dismissed[uuid] = self._known[uuid]

    def members(self, now: float) -> list[Member]:
        """The others with what counts now, in the order of their uuids: a bid that is none or stale is left out."""
        return [self._sound(self._known[uuid], now) for uuid in sorted(self._known)]

    @property
    def epoch(self) -> int:
        """The highest round that any of them has reached."""
        return max((member.epoch for member in self._known.values()), default=0)

    def _sound(self, member: Member, now: float) -> Member:
        if member.uuid in self._dismissed:
            return replace(member, cost=None, available=False, status=IDLE)
        since = now - self._came[member.uuid]
        is_sound = is_bid(member.cost) and not is_stale(member, since) and math.isfinite(since)
        return member if member.cost is None or is_sound else replace(member, cost=None)
