"""The motion capabilities of a robot, derived from its description and its response to commands; pure.

Behaviours get speeds, the lens and rangers from here, so they do not depend on the kind of robot. A robot without a
description has the capabilities of the simulated ERS-7.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from agents.detection import Executor, run_now
from drivers.reading import Action, Description, Value

STAND = {"base.vx": 0.0, "base.vy": 0.0, "base.wz": 0.0}
MAX_SEARCH_TURN_RADPS = 1.6
"""Maximum turn rate in rad/s while searching: faster turns blur pictures, which also arrive late."""
WALK_SPEED_MPS = 0.16
FAST_WALK_SPEED_MPS = 0.3
"""Walking speed in m/s of a robot with a ranger that measures the distance ahead.

``WALK_SPEED_MPS`` is for robots that detect obstacles by touch.
"""
LOOKAHEAD_S = 3.0
"""Seconds of walking that the ranger must cover, so that the robot can stop in time."""
FACING_TOLERANCE_RAD = math.radians(3.0)
MAX_FACING_TOLERANCE_RAD = math.radians(12.0)
CAMERA_AHEAD_M = 0.10
"""Metres from the robot's centre to its camera if the description has no ``ahead``."""
ERS7_FIELD_OF_VIEW_RAD = math.radians(56.9), math.radians(45.2)
"""Horizontal and vertical field of view of the ERS-7's camera."""
STOP_DISTANCE_M = 0.12
"""Metres between head and target at the end of the task: the robot is near and does not touch the target."""
MIN_TARGET_CLEARANCE_M = 0.08
"""Minimum metres between a wide robot and the target."""
DETECTION_TTL_S = 0.5
"""Seconds for which the newest sighting counts as seeing the target."""
DEFAULT_FPS = 15.0
ERS7_LIMITS = {"base.vx": (-0.156, 0.160), "base.vy": (-0.103, 0.103), "base.wz": (-2.03, 2.03)}
"""The limits of an ERS-7: m/s and rad/s."""
REACTION_TIME_S = 0.1
"""Seconds from a command to the motion, not counting the wait for the next picture."""
NEAR_RANGERS, FRONT_RANGERS = ("near", "front"), ("near", "far", "front")
"""The names of the rangers that look straight ahead: those for short distances, and all."""
FRONT_LIGHT_BUMPERS = ("front_left", "center_left", "center_right", "front_right")
LIGHT_BUMPER_RANGE_M = 0.35
"""Metres below which a light bumper reports a hit; a light bumper does not measure the distance."""
SPEED_UP_FACTOR = 1.5
"""Factor by which a command is increased after a command that was too slow to move the robot."""
INITIAL_CIRCLE_RADIUS_M = 0.3
"""Initial radius in metres of the circle of a robot that turns only while walking."""


class MotionCapabilities:
    """The motion capabilities of one robot, given by ``description``.

    ``walk`` (m/s) and ``turn`` (rad/s) are the maximum speeds that its sensors allow.  ``lens`` is the camera's
    horizontal and vertical field of view in radians (vertical None: square pixels).  ``ahead`` and ``radius`` are in
    metres.  ``run`` decodes its pictures.
    """

    def __init__(self, description: Description | None = None, run: Executor = run_now) -> None:
        self.run = run
        if description is None:
            description = Description("", "", {"ranger": {"max": 1.5}}, ERS7_LIMITS, 0.12)
        self._keys = description.limits
        self.strafes = self._max_speed("base.vy") > 0.0
        self.ranges = "ranger" in description.capabilities
        """Whether the robot measures the range ahead."""
        camera = description.capabilities.get("camera", {})
        reach = _number(description.capabilities.get("ranger", {}), "max", LOOKAHEAD_S)
        swift = max(WALK_SPEED_MPS, min(FAST_WALK_SPEED_MPS, reach / LOOKAHEAD_S)) if self.ranges else WALK_SPEED_MPS
        self.walk = min(swift, self._max_speed("base.vx"))
        self.turn = self._max_speed("base.wz")
        across = _number(camera, "fov_h_deg", math.nan)
        up = _number(camera, "fov_v_deg", math.nan)
        self.lens: tuple[float, float | None] = ERS7_FIELD_OF_VIEW_RAD
        if not math.isnan(across):
            self.lens = math.radians(across), None if math.isnan(up) else math.radians(up)
        fps = max(0.5, description.rates.get("camera", DEFAULT_FPS))
        # Half a field of view per picture, so that the camera misses nothing while turning.
        self.look_turn = min(MAX_SEARCH_TURN_RADPS, self.turn, max(0.5, 0.5 * self.lens[0] * fps))
        self.ahead = _number(camera, "ahead", CAMERA_AHEAD_M)
        self.radius = description.radius
        self.is_walking = False
        """Whether the last command made the robot walk ahead."""
        self.fresh = max(DETECTION_TTL_S, min(2.5 / fps, 3 * DETECTION_TTL_S))
        self.circle = 0.0
        """The radius in metres of the circle on which the robot turns; 0: it turns on the spot."""
        self._reaction = REACTION_TIME_S + 1.0 / fps
        self._least_turn = self._least_walk = 0.0
        self._step = self._stride = 0.0

    @property
    def facing_tolerance(self) -> float:
        """The accuracy in radians with which the robot can face a target; half a step if it turns in steps."""
        return max(FACING_TOLERANCE_RAD, min(MAX_FACING_TOLERANCE_RAD, 0.75 * self._step * self._reaction))

    @property
    def stop_distance(self) -> float:
        """Metres between camera and target on arrival: the space to stand, and to finish the last stride."""
        last = min(MIN_TARGET_CLEARANCE_M / 2, self._stride * self._reaction)
        return max(STOP_DISTANCE_M, self.radius - self.ahead + MIN_TARGET_CLEARANCE_M) + last

    @property
    def is_coarse(self) -> bool:
        """Whether the robot turns in such large steps that it cannot face a target exactly."""
        return self.facing_tolerance > FACING_TOLERANCE_RAD

    def spin(self, wz: float) -> Action:
        """Return the action that turns with ``wz`` rad/s, on the spot or on the robot's smallest circle."""
        if 0.0 < abs(wz) < self._least_turn:
            wz = math.copysign(self._least_turn, wz)
        return {**STAND, "base.vx": self.walk if self.circle and wz else 0.0, "base.wz": wz}

    def go(self, vx: float, wz: float = 0.0) -> Action:
        """Return the action that walks with ``vx`` m/s, or the robot's lowest speed, and turns with ``wz`` rad/s."""
        if 0.0 < abs(vx) < self._least_walk:
            vx = math.copysign(self._least_walk, vx)
        return {**STAND, "base.vx": vx, "base.wz": wz}

    def remove_missing_axes(self, action: Action) -> Action:
        """Return ``action`` without zero speeds on axes that the robot lacks.

        Other speeds are left for the driver to reject.
        """
        return {key: value for key, value in action.items() if key in self._keys or value}

    def learn(self, wished: Action, done: Action) -> None:
        """Adapt the capabilities to ``done``, the actual motion after the command ``wished``."""
        vx, wz = wished.get("base.vx", 0.0), wished.get("base.wz", 0.0)
        real_vx, real_wz = done.get("base.vx", vx), done.get("base.wz", wz)
        self.is_walking = real_vx > 0.0
        if wished.get("base.vy", 0.0):
            return
        if real_vx > 1.05 * vx + 0.01 and vx > 0.0:
            self._stride = real_vx if not self._stride else min(self._stride, real_vx)
        if wz and real_wz and abs(real_wz) > 1.05 * abs(wz) + 0.02:
            self._step = abs(real_wz) if not self._step else min(self._step, abs(real_wz))
        if wz and not vx and not real_wz:
            # The command was too slow for the robot; if even the fastest rate is, the robot turns only while walking.
            if abs(wz) >= 0.99 * min(self.turn, self.look_turn):
                self.circle = self.circle or INITIAL_CIRCLE_RADIUS_M
            else:
                self._least_turn = max(self._least_turn, min(SPEED_UP_FACTOR * abs(wz), self.look_turn))
        if vx and not wz and not real_vx and abs(vx) < self.walk:
            self._least_walk = max(self._least_walk, min(SPEED_UP_FACTOR * abs(vx), self.walk))
        if self.circle and real_vx and real_wz:
            self.circle = abs(real_vx / real_wz)

    def _max_speed(self, key: str) -> float:
        return self._keys[key][1] if key in self._keys else 0.0


def is_bumped(values: Mapping[str, Value]) -> bool:
    """Return whether a bump sensor reports contact."""
    return any(value is True and key.startswith("bump.") for key, value in values.items())


def is_light_bumper_hit(values: Mapping[str, Value]) -> bool:
    """Return whether a light bumper that looks ahead reports a hit."""
    return any(values.get(f"lightbump.{name}.hit") is True for name in FRONT_LIGHT_BUMPERS)


def _number(properties: Mapping[str, float | str], key: str, default: float) -> float:
    value = properties.get(key, default)
    return value if isinstance(value, int | float) and math.isfinite(value) and value > 0.0 else default
