"""Find the red target and keep it in view for some time, while standing; for robots and phones.

A device that reports the target itself (``target.bearing``, ``target.distance``; a phone detects it in the page) is
trusted.  Pictures of other devices are searched as in ``agents.search``.  A robot turns by itself; a phone is turned by
its user.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping
from typing import TYPE_CHECKING

from twisted.logger import Logger

from agents.context import Context
from agents.motion import MotionCapabilities
from drivers.reading import Action, Observation

if TYPE_CHECKING:
    from agents.search import SearchAndApproach

BEARING, DISTANCE = "target.bearing", "target.distance"
STAND: Action = {}
"""The action of a device without motors."""
DEFAULT_SECONDS, MAX_SECONDS = 10.0, 3600.0
TARGET_MEMORY_S = 2.0
"""Seconds for which a phone that lost sight of the target still counts as near it, because hands shake."""
DETECTION_TTL_S = 0.5
MIN_DETECTIONS = 3
"""Number of sightings before a distance is reported, which is their median."""
MAX_STEP_S = 0.25
"""Maximum seconds between two observations for the time between them to count as in view."""

_log = Logger()


class WatchTarget:
    """One device and one red target.

    ``parameters`` may have ``seconds``, the total time for which the target must be in view, and ``target_radius`` and
    ``target_height`` in metres.
    """

    def __init__(self, parameters: Mapping[str, float | str], rng: random.Random) -> None:
        self._needed_s = float(parameters.get("seconds", DEFAULT_SECONDS))
        if not 0.0 < self._needed_s <= MAX_SECONDS:
            raise ValueError(f"seconds must be more than 0 and at most {MAX_SECONDS:g}, is {self._needed_s:g}")
        self._parameters = parameters
        self._rng = rng
        self._finder: ReportedTarget | SearchAndApproach | None = None
        self._has_motors = False
        self._motion: MotionCapabilities | None = None
        self._watched_s = 0.0
        self._looked_at: float | None = None

    def embody(self, motion: MotionCapabilities) -> None:
        """Use the motion capabilities of this robot."""
        self._motion = motion

    def look(self, seen: Observation, now: float) -> None:
        """Process an observation; the first observation determines the kind of device."""
        if self._finder is None:
            self._has_motors = "odom.yaw" in seen.values
            self._finder = self._create_finder(seen)
        self._finder.look(seen, now)

    @property
    def cost(self) -> float | None:
        """Metres to the target; None while it is not seen."""
        return None if self._finder is None else self._finder.cost

    @property
    def progress(self) -> float:
        """The share of the required time for which the target was in view."""
        return min(1.0, self._watched_s / self._needed_s)

    def search(self, now: float) -> Action:
        """Turn and walk until the target is seen, then face it; a device without motors waits to be turned."""
        action = STAND if self._finder is None else self._finder.search(now)
        return action if self._has_motors else STAND

    def hold(self, now: float) -> Action:
        """Keep facing the target."""
        return self.search(now)

    def execute(self, context: Context) -> Action | None:
        """Keep facing the target; None when the target has been in view for long enough."""
        now, before = context.now, self._looked_at if context.is_resumed else None
        is_in_view = self._finder is not None and self._finder.is_in_view(now)
        if is_in_view and before is not None:
            self._watched_s += min(MAX_STEP_S, max(0.0, now - before))
        self._looked_at = now if is_in_view else None
        return None if self._watched_s >= self._needed_s else self.search(now)

    def _create_finder(self, seen: Observation) -> ReportedTarget | SearchAndApproach:
        if BEARING in seen.values:
            return ReportedTarget()
        try:
            from agents.search import SearchAndApproach  # only this class needs the libraries of ``search``
        except ImportError as error:
            _log.warn(
                "pictures cannot be searched ({error}); install the extra: pip install 'swarm-node[vision]'",
                error=error,
            )
            return ReportedTarget()
        size = {key: value for key, value in self._parameters.items() if key.startswith("target_")}
        finder = SearchAndApproach(size, self._rng)
        if self._motion is not None:
            finder.embody(self._motion)
        return finder


class ReportedTarget:
    """Reads the target's position from the observations of a device that detects the target itself."""

    def __init__(self) -> None:
        self._distances: list[float] = []
        self._seen_at = self._now = -math.inf

    @property
    def cost(self) -> float | None:
        """The median of the newest distances; None if there are too few or the target is out of view."""
        if len(self._distances) < MIN_DETECTIONS or self._now - self._seen_at > TARGET_MEMORY_S:
            return None
        return sorted(self._distances)[len(self._distances) // 2]

    def look(self, seen: Observation, now: float) -> None:
        """Process the target's position; NaN or a missing value means that the target is not in view."""
        self._now = now
        bearing, distance = seen.values.get(BEARING), seen.values.get(DISTANCE)
        if _is_number(bearing) and _is_number(distance):
            assert isinstance(distance, float | int)
            if now - self._seen_at > TARGET_MEMORY_S:
                self._distances = []
            self._distances = [*self._distances, float(distance)][-2 * MIN_DETECTIONS - 1 :]
            self._seen_at = now

    def is_in_view(self, now: float) -> bool:
        """Return whether the device reported the target within ``DETECTION_TTL_S``."""
        return now - self._seen_at <= DETECTION_TTL_S

    def search(self, now: float) -> Action:
        """Stand: the user turns the device."""
        return STAND


def _is_number(value: object) -> bool:
    return isinstance(value, float | int) and math.isfinite(value)
