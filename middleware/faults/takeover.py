"""Measure the time from a fault until another device continues the task.  Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from middleware.directory.presence import EXECUTING, Device

TARGET_S = 2.0
"""Seconds within which another device should take over."""
OBSERVATION_S = 5.0
"""A takeover is still recorded within this number of seconds after the end of a fault."""


def find_executing(devices: Iterable[Device]) -> dict[str, str]:
    """Return the task id of each device that executes a task, by uuid."""
    return {device.uuid: device.task for device in devices if device.status == EXECUTING and device.task}


@dataclass
class Takeover:
    """The takeover after one fault of the device ``lost``.

    ``task`` is the id of the task that the device executed.  It is empty if the device executed no task; then there is
    nothing to take over.  ``began`` and ``until`` are times on the observer's clock.  When another device executes the
    task, ``seconds`` is the duration of the takeover and ``to`` the uuid of that device; until then they are None and
    empty.
    """

    lost: str
    task: str
    began: float
    until: float
    seconds: float | None = None
    to: str = ""

    def observe(self, acts: Mapping[str, str], now: float) -> bool:
        """Record the executing devices (uuid to task) at ``now``; return True if this call detects the takeover."""
        if not self.is_open(now):
            return False
        others = sorted(uuid for uuid, task in acts.items() if task == self.task and uuid != self.lost)
        if others:
            self.seconds, self.to = now - self.began, others[0]
        return bool(others)

    def is_open(self, now: float) -> bool:
        """Return whether a takeover can still be observed."""
        return bool(self.task) and self.seconds is None and now < self.until + OBSERVATION_S
