"""SearchAndApproach: turn until the target is seen, face it, tell how far it is, and walk up to it (thesis, section 5).

Distance comes from the infrared ranger once the dog faces the target, cross-checked with the size in the picture: a
ranger that reads something else (a dog in between, a wall behind) is not believed.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping

from agents.behaviour import STAND
from agents.circling import Circling
from agents.context import Context
from agents.exploration import TURN_GAIN, TURN_SPEED, WALK, Exploration, Pose, clipped
from agents.formation import Post
from agents.vision import Sighting, Size, find_target
from drivers.reading import Action, Observation

FACING = math.radians(3.0)
CAMERA_AHEAD = 0.10
"""Metres from the robot's centre to its camera."""
TURN_FIRST = math.radians(25)
IN_THE_WAY = 0.30
SIDESTEP, CREEP = 0.10, 0.04
STOP_AT = 0.12
"""Metres left between the head and the target when the task is done: near, and not touching."""
MEMORY = 4.0
"""Seconds for which a target out of sight is still believed to be where it was: another dog may only be passing by."""
FRESH = 0.5
"""Seconds since the newest sighting that still count as seeing the target."""
DISAGREEMENT = 0.25
SETTLE = 3
MAX_SIZE = 5.0


class SearchAndApproach:
    """One dog and one red target; ``parameters`` may give ``target_radius`` and ``target_height`` in metres."""

    def __init__(self, parameters: Mapping[str, float | str], rng: random.Random) -> None:
        self._radius = _metres(parameters, "target_radius", 0.08)
        self._size = Size(self._radius, _metres(parameters, "target_height", 0.22))
        self._side = rng.choice((-1.0, 1.0))
        self._exploration = Exploration(rng)
        self._target: tuple[float, float] | None = None
        self._seen_at = self._looked_at = -math.inf
        self._frame = -1
        self._ranges: dict[str, float] = {}
        self._pose: Pose = (0.0, 0.0, 0.0)
        self._has_pose = False
        self._distances: list[float] = []
        self._done_for = 0
        self._circling = Circling()
        self._way = 0.0
        self._north: float | None = None

    # -- observing --------------------------------------------------------------------------------------------------

    def look(self, seen: Observation, now: float) -> None:
        """Take in odometry and rangers, and search the picture if it is a new one."""
        values = seen.values
        x, y, yaw = (float(values.get(f"odom.{axis}", 0.0)) for axis in ("x", "y", "yaw"))
        # Odometry counts from wherever the robot was switched on: the first pose is no turn.
        before = self._pose if self._has_pose else (x, y, yaw)
        self._pose, self._has_pose = (x, y, yaw), True
        for name in ("near", "far"):
            self._ranges[name] = float(values.get(f"range.{name}", math.nan))
        heading = values.get("compass.heading")
        self._north = None if heading is None else math.remainder(float(heading) - yaw, math.tau)
        self._exploration.saw(self._pose, math.remainder(yaw - before[2], math.tau), self._ahead)
        if seen.frame is not None and seen.frame.seq != self._frame:
            self._frame = seen.frame.seq
            self._saw(find_target(seen.frame.data, self._size), now)
        if self._circling.is_walking:
            self._looked_at = now  # it looks elsewhere, and the target stays where it is
        if now - self._looked_at > MEMORY:
            self._forget()

    def _saw(self, sighting: Sighting | None, now: float) -> None:
        if sighting is None:
            return
        self._seen_at = self._looked_at = now
        # Where it stands in the robot's own odometry: between pictures the body turns and walks, the target does not.
        x, y, yaw = self._pose
        reach, towards = sighting.distance + CAMERA_AHEAD, yaw + sighting.bearing
        self._target = (x + reach * math.cos(towards), y + reach * math.sin(towards))
        if abs(sighting.bearing) < FACING:
            self._distances = [*self._distances, self._measured(sighting)][-9:]

    def _measured(self, sighting: Sighting) -> float:
        """Metres from the head: the ranger's where it agrees with the picture, else the picture's."""
        for name in ("near", "far"):
            ranged = self._ranges[name] + self._radius
            if abs(ranged - sighting.distance) < DISAGREEMENT * sighting.distance:
                return ranged
        return sighting.distance

    def _forget(self) -> None:
        self._target = None
        self._distances = []
        self._done_for = 0

    @property
    def _bearing(self) -> float:
        """Radians from straight ahead to the target, left positive."""
        assert self._target is not None
        x, y, yaw = self._pose
        return math.remainder(math.atan2(self._target[1] - y, self._target[0] - x) - yaw, math.tau)

    @property
    def _distance(self) -> float:
        """Metres from the camera to the target's axis."""
        assert self._target is not None
        return max(0.0, math.dist(self._pose[:2], self._target) - CAMERA_AHEAD)

    @property
    def cost(self) -> float | None:
        """Metres to the target: the median of the newest measurements, once there are enough of them."""
        if self._target is None or len(self._distances) < SETTLE:
            return None
        ordered = sorted(self._distances)
        return ordered[len(ordered) // 2]

    @property
    def angle(self) -> float | None:
        """Where the dog stands as seen from the target, by the compass; None without target or compass."""
        if self._target is None or self._north is None:
            return None
        x, y, _ = self._pose
        outward = math.atan2(y - self._target[1], x - self._target[0])
        return math.remainder(outward + self._north, math.tau)

    @property
    def progress(self) -> float | None:
        """The share of the way that is done, from where the dog stood by; None where it did not, or sees nothing."""
        return None if self._target is None or not self._way else max(0.0, 1.0 - self._gap / self._way)

    def is_in_view(self, now: float) -> bool:
        """Whether the newest sighting still counts as seeing the target."""
        return now - self._seen_at <= FRESH

    # -- acting -----------------------------------------------------------------------------------------------------

    def search(self, now: float) -> Action:
        """Look around and walk to new places; something seen, face it."""
        return self._exploration.step(self._pose, self._ahead) if self._target is None else self._face()

    def hold(self, now: float) -> Action:
        """Stand at the post and keep facing the target, ready to take over."""
        if self._target is None:
            return self.search(now)
        self._way = self._gap
        is_facing = abs(self._bearing) < FACING and self.is_in_view(now)
        return self._circling.step(self._pose, self._target, self.angle, self._ahead, is_facing) or self._face()

    def take_post(self, post: Post) -> None:
        """Stand there from now on while another acts, and search that sector while there is nothing to be seen."""
        self._circling.send(post.angle)
        if self._north is not None:
            self._exploration.sector = math.remainder(post.sector[0] - self._north, math.tau), post.sector[1]

    def execute(self, context: Context) -> Action | None:
        """Walk up to the target and stop before touching it; None once the dog stands there."""
        now = context.now
        self._circling.rest()
        if self._target is None:
            return self.search(now)
        bearing, gap = self._bearing, self._gap
        turn = clipped(TURN_GAIN * bearing, TURN_SPEED)
        if gap <= STOP_AT and abs(bearing) < 4 * FACING:
            # Arriving at a memory is no arrival: the target must be before the eyes, or the dog waits until it forgets.
            self._done_for = self._done_for + 1 if self.is_in_view(now) else 0
            return None if self._done_for >= SETTLE else {**STAND, "base.wz": turn}
        self._done_for = 0
        if abs(bearing) > TURN_FIRST:
            return {**STAND, "base.wz": turn}
        if self._ahead < IN_THE_WAY and self._ahead + self._radius < self._distance * (1 - DISAGREEMENT) - 0.05:
            # Something stands between: step aside, keep the eyes on the target.
            return {**STAND, "base.vy": self._side * SIDESTEP, "base.wz": turn}
        return {**STAND, "base.vx": clipped(max(CREEP, gap - STOP_AT), WALK), "base.wz": turn}

    @property
    def _gap(self) -> float:
        """Metres between the head and the surface of the target."""
        believed = max(0.0, self._distance - self._radius)
        near = self._ranges.get("near", math.nan)
        is_it = abs(self._bearing) < 4 * FACING and abs(near - believed) < 0.12
        return near if is_it else believed

    def _face(self) -> Action:
        bearing = self._bearing
        return STAND if abs(bearing) < FACING * 0.7 else {**STAND, "base.wz": clipped(TURN_GAIN * bearing, TURN_SPEED)}

    @property
    def _ahead(self) -> float:
        """Metres to whatever is straight ahead; NaN where nothing is within reach."""
        return min((r for r in self._ranges.values() if not math.isnan(r)), default=math.nan)


def _metres(parameters: Mapping[str, float | str], name: str, usual: float) -> float:
    value = float(parameters.get(name, usual))
    if not 0.0 < value <= MAX_SIZE:
        raise ValueError(f"{name} must be more than 0 and at most {MAX_SIZE:g} m, is {value:g}")
    return value
