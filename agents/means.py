"""Means: what a body can do, out of its description and out of what it did when it was told to move; pure.

Behaviours ask here for velocities, a lens and rangers, and never for a kind of robot.  A body that says nothing of
itself has the means of the simulated ERS-7.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from agents.detection import Run, run_now
from drivers.reading import Action, Description, Value

STAND = {"base.vx": 0.0, "base.vy": 0.0, "base.wz": 0.0}
TURN_SPEED = 1.6
"""Nobody turns faster than that, in rad/s: pictures blur, and come late."""
WALK = 0.16
SWIFT = 0.3
"""Metres a second of a body that ranges what lies ahead; ``WALK`` is for one that feels it only when it is there."""
SECONDS_AHEAD = 3.0
"""A body that walks at most so far as it sees in so many seconds can stop before what it sees."""
FACING = math.radians(3.0)
COARSEST = math.radians(12.0)
CAMERA_AHEAD = 0.10
"""Metres from the middle of a robot to its camera, where its description does not say ``ahead``."""
VIEW = math.radians(56.9), math.radians(45.2)
"""Across and up, of the ERS-7's camera."""
STOP_AT = 0.12
"""Metres left between the head and the target when the task is done: near, and not touching."""
ROOM = 0.08
"""What is left at least between the body of a broader robot and the target."""
FRESH = 0.5
"""Seconds since the newest sighting that still count as seeing the target."""
FPS = 15.0
USUAL = {"base.vx": (-0.156, 0.160), "base.vy": (-0.103, 0.103), "base.wz": (-2.03, 2.03)}
"""The limits of an ERS-7."""
REACTION = 0.1
"""Seconds from a command to the motion, beside the wait for the next picture."""
NEAR, FAR = ("near", "front"), ("near", "far", "front")
"""The rangers that look straight ahead: those that measure to the last, and all."""
LIGHTS = ("front_left", "center_left", "center_right", "front_right")
LIT = 0.35
"""A light bumper that is hit says that something is nearer than that, and not how near."""
MORE = 1.5
"""So much faster than what was too slow is tried next."""
CIRCLE = 0.3
"""Metres: the circle of a body that turns only as it walks, until it has shown its own."""


class Means:
    """The means of one body, told by ``description``.

    ``walk`` (m/s) and ``turn`` (rad/s) are the highest speeds for what it senses, ``lens`` is what the camera sees
    across and up in radians (up None: as across, for the picture's pixels are square), ``ahead`` and ``radius`` are in
    metres.  ``run`` is where its pictures are decoded.
    """

    def __init__(self, description: Description | None = None, run: Run = run_now) -> None:
        self.run = run
        if description is None:
            description = Description("", "", {"ranger": {"max": 1.5}}, USUAL, 0.12)
        self._keys = description.limits
        self.strafes = self._most("base.vy") > 0.0
        self.ranges = "ranger" in description.capabilities
        """Whether it measures how far what lies ahead is."""
        camera = description.capabilities.get("camera", {})
        reach = _number(description.capabilities.get("ranger", {}), "max", SECONDS_AHEAD)
        swift = max(WALK, min(SWIFT, reach / SECONDS_AHEAD)) if self.ranges else WALK
        self.walk = min(swift, self._most("base.vx"))
        self.turn = self._most("base.wz")
        across = _number(camera, "fov_h_deg", math.nan)
        up = _number(camera, "fov_v_deg", math.nan)
        self.lens: tuple[float, float | None] = VIEW
        if not math.isnan(across):
            self.lens = math.radians(across), None if math.isnan(up) else math.radians(up)
        fps = max(0.5, description.rates.get("camera", FPS))
        # Half a view from one picture to the next: nothing slips through between two.
        self.look_turn = min(TURN_SPEED, self.turn, max(0.5, 0.5 * self.lens[0] * fps))
        self.ahead = _number(camera, "ahead", CAMERA_AHEAD)
        self.radius = description.radius
        self.is_walking = False
        """Whether it walks ahead since it was told to move last."""
        self.fresh = max(FRESH, min(2.5 / fps, 3 * FRESH))
        self.circle = 0.0
        """The radius in metres of the circle on which it turns; 0: on the spot."""
        self._reaction = REACTION + 1.0 / fps
        self._least_turn = self._least_walk = 0.0
        self._step = self._stride = 0.0

    @property
    def aim(self) -> float:
        """How well it can face something, in radians: whoever turns in steps is content with half a step."""
        return max(FACING, min(COARSEST, 0.75 * self._step * self._reaction))

    @property
    def stop_at(self) -> float:
        """Metres between its camera and a thing at which it has arrived: room to stand, and for its last stride."""
        last = min(ROOM / 2, self._stride * self._reaction)
        return max(STOP_AT, self.radius - self.ahead + ROOM) + last

    @property
    def is_coarse(self) -> bool:
        """Whether it turns in such steps that it cannot face a thing exactly."""
        return self.aim > FACING

    def spin(self, wz: float) -> Action:
        """Turn with ``wz`` rad/s on the spot, or as narrowly and as slowly as it can."""
        if 0.0 < abs(wz) < self._least_turn:
            wz = math.copysign(self._least_turn, wz)
        return {**STAND, "base.vx": self.walk if self.circle and wz else 0.0, "base.wz": wz}

    def go(self, vx: float, wz: float = 0.0) -> Action:
        """Walk with ``vx`` m/s, or as slowly as it can, and turn with ``wz`` rad/s."""
        if 0.0 < abs(vx) < self._least_walk:
            vx = math.copysign(self._least_walk, vx)
        return {**STAND, "base.vx": vx, "base.wz": wz}

    def fitted(self, action: Action) -> Action:
        """``action`` without rest on the axes that the body does not have; what moves them is left to be refused."""
        return {key: value for key, value in action.items() if key in self._keys or value}

    def did(self, wished: Action, done: Action) -> None:
        """Learn from what the body does (``done``) when it is told to do ``wished``."""
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
            # Too slow for it; and where the fastest is too slow it turns only as it walks.
            if abs(wz) >= 0.99 * min(self.turn, self.look_turn):
                self.circle = self.circle or CIRCLE
            else:
                self._least_turn = max(self._least_turn, min(MORE * abs(wz), self.look_turn))
        if vx and not wz and not real_vx and abs(vx) < self.walk:
            self._least_walk = max(self._least_walk, min(MORE * abs(vx), self.walk))
        if self.circle and real_vx and real_wz:
            self.circle = abs(real_vx / real_wz)

    def _most(self, key: str) -> float:
        return self._keys[key][1] if key in self._keys else 0.0


def is_bumped(values: Mapping[str, Value]) -> bool:
    """Whether the body feels that it touches something."""
    return any(value is True and key.startswith("bump.") for key, value in values.items())


def is_lit(values: Mapping[str, Value]) -> bool:
    """Whether a light bumper that looks ahead is hit."""
    return any(values.get(f"lightbump.{name}.hit") is True for name in LIGHTS)


def _number(properties: Mapping[str, float | str], key: str, usual: float) -> float:
    value = properties.get(key, usual)
    return value if isinstance(value, int | float) and math.isfinite(value) and value > 0.0 else usual
