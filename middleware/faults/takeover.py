"""A clock that runs from a fault until another device goes on with the task.  Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from middleware.presence import EXECUTING, Device

TARGET_S = 2.0
"""Seconds within which another shall have taken over."""
WATCHED_S = 5.0
"""Seconds after the end of a fault for which one still looks whether another takes over."""


def acting(devices: Iterable[Device]) -> dict[str, str]:
    """Who acts: uuid to task."""
    return {device.uuid: device.task for device in devices if device.status == EXECUTING and device.task}


@dataclass
class Takeover:
    """The clock of one fault of the device ``lost``.

    ``task`` is what it was at, empty where it did not act: then there is nothing to take over.  ``began`` and ``until``
    are seconds of whoever looks; ``seconds`` and ``to`` (a uuid) are None and empty until another acts on the task.
    """

    lost: str
    task: str
    began: float
    until: float
    seconds: float | None = None
    to: str = ""

    def look(self, acts: Mapping[str, str], now: float) -> bool:
        """Take in who acts (uuid to task) at the moment ``now``; True where that is what stops the clock."""
        if not self.is_open(now):
            return False
        others = sorted(uuid for uuid, task in acts.items() if task == self.task and uuid != self.lost)
        if others:
            self.seconds, self.to = now - self.began, others[0]
        return bool(others)

    def is_open(self, now: float) -> bool:
        """Whether the clock runs: somebody may still take over."""
        return bool(self.task) and self.seconds is None and now < self.until + WATCHED_S
