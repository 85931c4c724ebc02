"""Search for the red target, face it, report its distance, and walk up to it (thesis, section 5).

Once the robot faces the target, a ranger that looks ahead measures the distance. Because the ranger may measure
another dog or a wall, the result is checked against the target's size in the picture. Without a ranger the distance
comes from the picture, and a bump into the target also counts as arrival.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from agents.context import Context
from agents.detection import Detector
from agents.exploration import TURN_GAIN, Detour, Exploration, Pose, clip
from agents.formation import Post, PostPath
from agents.motion import (
    FRONT_RANGERS,
    LIGHT_BUMPER_RANGE_M,
    NEAR_RANGERS,
    STAND,
    MotionCapabilities,
    is_bumped,
    is_light_bumper_hit,
)
from agents.vision import Detection, TargetSize, find_target
from drivers.reading import Action, Observation

ARRIVAL_BEARING_RAD = math.radians(12.0)
"""Maximum bearing of the target on arrival: the robot then faces the target."""
MAX_WALK_BEARING_RAD = math.radians(25)
OBSTACLE_RANGE_M = 0.30
SIDESTEP_SPEED_MPS, CREEP_SPEED_MPS = 0.10, 0.04
SIDESTEP_RADII = 2.0
"""Radii that a robot continues sideways after its camera has passed an obstacle, because its body is wider."""
TOUCH_DISTANCE_M = 0.30
"""A bump counts as a bump into the target if the robot faces the target within this many metres."""
TIGHT_TURN_RADII = 3.0
"""A robot that cannot turn on the spot first backs off if a target to its side is within this many circle radii."""
TARGET_MEMORY_S = 4.0
"""Seconds for which a target out of sight is assumed to stay: another dog may be passing."""
HIDDEN_TARGET_MEMORY_S = 30.0
"""Seconds for which the target is assumed to stay if an obstacle hides it: a robot that failed there does not leave."""
MAX_RANGE_DISAGREEMENT = 0.25
MIN_DETECTIONS = 3
STUCK_DISTANCE_M, STUCK_TIME_S = 0.02, 1.5
"""A walking robot is stuck if it moves less than this distance (metres) in this time (seconds)."""
MAX_TARGET_SIZE_M = 5.0


class SearchAndApproach:
    """One robot and one red target; ``parameters`` may have ``target_radius`` and ``target_height`` in metres."""

    def __init__(self, parameters: Mapping[str, float | str], rng: random.Random) -> None:
        self._radius = _read_metres(parameters, "target_radius", 0.08)
        self._size = TargetSize(self._radius, _read_metres(parameters, "target_height", 0.22))
        self._side = rng.choice((-1.0, 1.0))
        self._exploration = Exploration(rng)
        self._target: tuple[float, float] | None = None
        self._seen_at = self._looked_at = -math.inf
        self._frame = -1
        self._ranges: dict[str, float] = {}
        self._pose: Pose = (0.0, 0.0, 0.0)
        self._has_pose = False
        self._distances: list[float] = []
        self._arrival_count = 0
        self._motion = MotionCapabilities()
        self._detector = Detector()
        self._post_path = PostPath(self._motion)
        self._detour = Detour(self._motion)
        self._is_lit = self._is_bumped = self._was_bumped = self._has_arrived = False
        self._last_moved: tuple[Pose, float] = (0.0, 0.0, 0.0), -math.inf
        self._called_at = -math.inf
        self._blocked_at = math.inf, math.inf
        self._initial_gap = 0.0
        self._north: float | None = None

    def embody(self, motion: MotionCapabilities) -> None:
        """Use the motion capabilities of this robot."""
        self._motion = self._exploration.motion = self._post_path.motion = self._detour.motion = motion
        self._detector.run = motion.run

    # -- observing --------------------------------------------------------------------------------------------------

    def look(self, seen: Observation, now: float) -> None:
        """Process odometry and ranges, and search a new picture for the target."""
        values = seen.values
        x, y, yaw = (float(values.get(f"odom.{axis}", 0.0)) for axis in ("x", "y", "yaw"))
        # Odometry starts at an arbitrary pose, so the first pose does not indicate a turn.
        before = self._pose if self._has_pose else (x, y, yaw)
        self._pose, self._has_pose = (x, y, yaw), True
        for name in FRONT_RANGERS:
            self._ranges[name] = float(values.get(f"range.{name}", math.nan))
        self._is_lit, self._is_bumped = is_light_bumper_hit(values), is_bumped(values)
        heading = values.get("compass.heading")
        self._north = None if heading is None else math.remainder(float(heading) - yaw, math.tau)
        self._exploration.update(self._pose, math.remainder(yaw - before[2], math.tau), self._ahead)
        if seen.frame is not None and seen.frame.seq != self._frame:
            self._frame = seen.frame.seq
            find = partial(find_target, seen.frame.data, self._size, self._motion.lens)
            self._detector.detect(find, partial(self._add_detection, now, self._pose))
        if self._post_path.is_walking or self._detour.is_active(now):
            self._looked_at = now  # the robot looks elsewhere; the target is assumed not to move
        elif (
            self.cost is not None
            and self._is_hidden
            and now - self._seen_at <= HIDDEN_TARGET_MEMORY_S - TARGET_MEMORY_S
        ):
            self._looked_at = now
        if now - self._looked_at > TARGET_MEMORY_S:
            self._forget_target()

    def _add_detection(self, now: float, pose: Pose, sighting: Detection | None) -> None:
        """Add a sighting from the picture that arrived at ``now``, when the robot was at ``pose``."""
        if sighting is None:
            return
        self._seen_at = self._looked_at = now
        # Stored in odometry coordinates: the robot moves between pictures, the target does not.
        x, y, yaw = pose
        if sighting.is_filling and self._target is not None and not self._motion.ranges:
            # The target is too near to be measured in the picture: use its last position and the distance walked since
            # then.
            sighting = replace(sighting, distance=min(sighting.distance, self._distance))
        reach, towards = sighting.distance + self._motion.ahead, yaw + sighting.bearing
        self._target = (x + reach * math.cos(towards), y + reach * math.sin(towards))
        if abs(sighting.bearing) < self._motion.facing_tolerance:
            self._distances = [*self._distances, self._measure_distance(sighting)][-9:]

    def _measure_distance(self, sighting: Detection) -> float:
        """Return the metres from the head: by the ranger if it agrees with the picture, else by the picture."""
        for name in FRONT_RANGERS:
            ranged = self._ranges[name] + self._radius
            if abs(ranged - sighting.distance) < MAX_RANGE_DISAGREEMENT * sighting.distance:
                return ranged
        return sighting.distance

    def _forget_target(self) -> None:
        self._target = None
        self._distances = []
        self._arrival_count = 0

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
        return max(0.0, math.dist(self._pose[:2], self._target) - self._motion.ahead)

    @property
    def _is_hidden(self) -> bool:
        """Whether an obstacle stands between the robot and the assumed position of the target."""
        if self._target is None or abs(self._bearing) > ARRIVAL_BEARING_RAD:
            return False
        return self._ahead + self._radius < self._distance * (1 - MAX_RANGE_DISAGREEMENT) - 0.05

    @property
    def cost(self) -> float | None:
        """Metres to the target: the median of the newest measurements; None until there are enough measurements."""
        if self._target is None or len(self._distances) < MIN_DETECTIONS:
            return None
        ordered = sorted(self._distances)
        return ordered[len(ordered) // 2]

    @property
    def angle(self) -> float | None:
        """The robot's direction as seen from the target, by the compass; None if target or compass is missing."""
        if self._target is None or self._north is None:
            return None
        x, y, _ = self._pose
        outward = math.atan2(y - self._target[1], x - self._target[0])
        return math.remainder(outward + self._north, math.tau)

    @property
    def progress(self) -> float | None:
        """The share of the distance walked since the last ``hold``; None before a ``hold``, or if no target is seen."""
        return None if self._target is None or not self._initial_gap else max(0.0, 1.0 - self._gap / self._initial_gap)

    def is_in_view(self, now: float) -> bool:
        """Return whether the target was seen recently enough to be in view."""
        return now - self._seen_at <= self._motion.fresh

    # -- acting -----------------------------------------------------------------------------------------------------

    def search(self, now: float) -> Action:
        """Look around and walk to new places; face the target once it is seen."""
        if self._target is not None:
            self._detour.cancel()
            return self._face_target()
        self._detect_stuck(now)
        return self._step_detour(now) or self._exploration.step(self._pose, self._ahead)

    def hold(self, now: float) -> Action:
        """Stand at the post and face the target."""
        if self._target is None:
            return self.search(now)
        self._detour.cancel()
        self._initial_gap = self._gap
        is_facing = abs(self._bearing) < self._motion.facing_tolerance and self.is_in_view(now)
        return self._post_path.step(self._pose, self._target, self.angle, self._ahead, is_facing) or self._face_target()

    def take_post(self, post: Post) -> None:
        """Move to ``post`` while another robot acts, and search its sector while no target is seen."""
        self._post_path.set_post(post.angle)
        if self._north is not None:
            self._exploration.sector = math.remainder(post.sector[0] - self._north, math.tau), post.sector[1]

    def execute(self, context: Context) -> Action | None:
        """Walk up to the target and stop before touching it; None when the robot has arrived."""
        now = context.now
        self._post_path.end_leg()
        if self._target is None:
            return self.search(now)
        self._detect_stuck(now)
        bearing, gap = self._bearing, self._gap
        motion = self._motion
        turn = clip(TURN_GAIN * bearing, motion.look_turn)
        is_facing = abs(bearing) < ARRIVAL_BEARING_RAD
        self._has_arrived = is_facing and gap <= TOUCH_DISTANCE_M and (self._is_bumped or self._has_arrived)
        if self._has_arrived or (gap <= motion.stop_distance and is_facing):
            # The target must be in view on arrival; otherwise the robot waits until its remembered position expires.
            self._arrival_count = self._arrival_count + 1 if self.is_in_view(now) else 0
            self._detour.cancel()
            is_enough = self._has_arrived or (motion.is_coarse and abs(bearing) < motion.facing_tolerance)
            return None if self._arrival_count >= MIN_DETECTIONS else STAND if is_enough else motion.spin(turn)
        self._arrival_count = 0
        detour = self._step_detour(now)
        if detour is not None:
            return detour
        if abs(bearing) > MAX_WALK_BEARING_RAD:
            if math.dist(self._pose[:2], self._target) < TIGHT_TURN_RADII * motion.circle:
                return motion.go(-CREEP_SPEED_MPS)  # the target is nearer than the robot's turning circle
            return motion.spin(turn)
        if self._ahead < OBSTACLE_RANGE_M and self._is_hidden:
            # An obstacle hides the target: step aside while facing the target, or make a detour.
            if not motion.strafes:
                self._detour.start(self._pose, self._side, now, has_touched=False)
                return self._step_detour(now) or STAND
            self._blocked_at = self._pose[:2]
        if math.dist(self._pose[:2], self._blocked_at) < SIDESTEP_RADII * motion.radius:
            return {**STAND, "base.vy": self._side * SIDESTEP_SPEED_MPS, "base.wz": turn}
        return motion.go(clip(max(CREEP_SPEED_MPS, gap - motion.stop_distance), motion.walk), turn)

    @property
    def _gap(self) -> float:
        """Metres between the head and the surface of the target."""
        believed = max(0.0, self._distance - self._radius)
        for name in NEAR_RANGERS:
            near = self._ranges.get(name, math.nan)
            if abs(self._bearing) < ARRIVAL_BEARING_RAD and abs(near - believed) < 0.12:
                # The ranger may be mounted behind the camera: then the picture is more accurate.
                return near if name == "near" else min(near, believed)
        return believed

    def _detect_stuck(self, now: float) -> None:
        """If a robot without a ranger walks but does not move, handle this as a bump."""
        is_walking = self._motion.is_walking and not self._motion.ranges and now - self._called_at < STUCK_TIME_S / 2
        self._called_at = now
        if not is_walking or math.dist(self._last_moved[0][:2], self._pose[:2]) > STUCK_DISTANCE_M:
            self._last_moved = self._pose, now
        self._is_bumped = self._is_bumped or now - self._last_moved[1] > STUCK_TIME_S

    def _step_detour(self, now: float) -> Action | None:
        """Return the next action of a detour around a touched obstacle; None if the robot is not on a detour."""
        if self._is_bumped and not self._was_bumped:
            self._detour.start(self._pose, self._side, now, has_touched=True)
            if self._target is None:
                self._exploration.on_bump(self._pose)
        self._was_bumped = self._is_bumped
        return self._detour.step(self._pose, self._ahead, now)

    def _face_target(self) -> Action:
        bearing, motion = self._bearing, self._motion
        is_facing = abs(bearing) < motion.facing_tolerance * 0.7
        return STAND if is_facing else motion.spin(clip(TURN_GAIN * bearing, motion.look_turn))

    @property
    def _ahead(self) -> float:
        """Metres to the next obstacle straight ahead; NaN if none is in range."""
        lit = [LIGHT_BUMPER_RANGE_M] if self._is_lit else []
        return min((r for r in (*self._ranges.values(), *lit) if not math.isnan(r)), default=math.nan)


def _read_metres(parameters: Mapping[str, float | str], name: str, default: float) -> float:
    value = float(parameters.get(name, default))
    if not 0.0 < value <= MAX_TARGET_SIZE_M:
        raise ValueError(f"{name} must be more than 0 and at most {MAX_TARGET_SIZE_M:g} m, is {value:g}")
    return value
