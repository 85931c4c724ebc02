"""WatchTarget: find the red target and keep it in view for a while, standing; for robots and for phones alike.

A body that tells where it sees the target (``target.bearing``, ``target.distance``: a phone, whose page looks for
itself) is believed.  Any other body's pictures are searched as those of the demonstration are.  What can turn by itself
turns; what cannot is moved by whoever holds it.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping
from typing import TYPE_CHECKING

from twisted.logger import Logger

from agents.context import Context
from agents.means import Means
from drivers.reading import Action, Observation

if TYPE_CHECKING:
    from agents.search import SearchAndApproach

BEARING, DISTANCE = "target.bearing", "target.distance"
STAND: Action = {}
"""What a body without motors does."""
SECONDS, MAX_SECONDS = 10.0, 3600.0
MEMORY = 2.0
"""Seconds for which a phone that lost sight of the target still counts as near it: hands shake."""
FRESH = 0.5
SETTLE = 3
"""Sightings until the distance is worth telling, and of how many it is the median."""
STEP = 0.25
"""Longer than this apart, two looks say nothing of what was in view between them."""

_log = Logger()


class WatchTarget:
    """One body and one red target.

    ``parameters`` may give ``seconds``, for how long in all the target is to be in view, and ``target_radius`` and
    ``target_height`` in metres.
    """

    def __init__(self, parameters: Mapping[str, float | str], rng: random.Random) -> None:
        self._needed = float(parameters.get("seconds", SECONDS))
        if not 0.0 < self._needed <= MAX_SECONDS:
            raise ValueError(f"seconds must be more than 0 and at most {MAX_SECONDS:g}, is {self._needed:g}")
        self._parameters = parameters
        self._rng = rng
        self._finder: Told | SearchAndApproach | None = None
        self._has_motors = False
        self._means: Means | None = None
        self._watched = 0.0
        self._looked_at: float | None = None

    def embody(self, means: Means) -> None:
        """Look and turn as this body can."""
        self._means = means

    def look(self, seen: Observation, now: float) -> None:
        """Take in what the body senses; its first observation says what sort of body it is."""
        if self._finder is None:
            self._has_motors = "odom.yaw" in seen.values
            self._finder = self._found(seen)
        self._finder.look(seen, now)

    @property
    def cost(self) -> float | None:
        """Metres to the target; None while it is not seen."""
        return None if self._finder is None else self._finder.cost

    @property
    def progress(self) -> float:
        """The share of the time for which it was in view."""
        return min(1.0, self._watched / self._needed)

    def search(self, now: float) -> Action:
        """Turn and walk until the target is seen, then face it; a body without motors waits to be turned."""
        action = STAND if self._finder is None else self._finder.search(now)
        return action if self._has_motors else STAND

    def hold(self, now: float) -> Action:
        """Keep facing it, ready to take over."""
        return self.search(now)

    def execute(self, context: Context) -> Action | None:
        """Keep facing it; None once it was in view for long enough."""
        now, before = context.now, self._looked_at if context.is_resumed else None
        is_in_view = self._finder is not None and self._finder.is_in_view(now)
        if is_in_view and before is not None:
            self._watched += min(STEP, max(0.0, now - before))
        self._looked_at = now if is_in_view else None
        return None if self._watched >= self._needed else self.search(now)

    def _found(self, seen: Observation) -> Told | SearchAndApproach:
        if BEARING in seen.values:
            return Told()
        try:
            from agents.search import SearchAndApproach  # a body that tells needs none of its libraries
        except ImportError as error:
            _log.warn("nothing can be seen here ({error}): pip install 'swarm-node[vision]'", error=error)
            return Told()
        size = {key: value for key, value in self._parameters.items() if key.startswith("target_")}
        finder = SearchAndApproach(size, self._rng)
        if self._means is not None:
            finder.embody(self._means)
        return finder


class Told:
    """The target where the body itself says that it is."""

    def __init__(self) -> None:
        self._distances: list[float] = []
        self._seen_at = self._now = -math.inf

    @property
    def cost(self) -> float | None:
        """The median of the newest distances, once there are enough, while it was in view a moment ago."""
        if len(self._distances) < SETTLE or self._now - self._seen_at > MEMORY:
            return None
        return sorted(self._distances)[len(self._distances) // 2]

    def look(self, seen: Observation, now: float) -> None:
        """Take in where the target is; NaN, or nothing, means that it is not in view."""
        self._now = now
        bearing, distance = seen.values.get(BEARING), seen.values.get(DISTANCE)
        if _is_number(bearing) and _is_number(distance):
            assert isinstance(distance, float | int)
            if now - self._seen_at > MEMORY:
                self._distances = []
            self._distances = [*self._distances, float(distance)][-2 * SETTLE - 1 :]
            self._seen_at = now

    def is_in_view(self, now: float) -> bool:
        """Whether it was said to be in view just now."""
        return now - self._seen_at <= FRESH

    def search(self, now: float) -> Action:
        """Whoever holds the body turns it."""
        return STAND


def _is_number(value: object) -> bool:
    return isinstance(value, float | int) and math.isfinite(value)
