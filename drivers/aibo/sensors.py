"""Names, units and bounds of the numbers in an ERS-7's world state, and its odometry; pure.

Names are Tekkotsu's.  The signs of the accelerometers follow its headers; they are not verified on a real dog.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from drivers.aibo.codec import T2, WorldState
from drivers.errors import BadFrame
from drivers.reading import Value

MODEL = "ERS-7"
JOINTS = (
    *(f"{leg}:{joint}" for leg in ("LFr", "RFr", "LBk", "RBk") for joint in ("rotor", "elvtr", "knee")),
    *("NECK:tilt", "NECK:pan", "NECK:nod", "TAIL:tilt", "TAIL:pan", "MOUTH"),
)
RANGES = {"near": (0.05, 0.5), "far": (0.2, 1.5), "chest": (0.1, 0.9)}
"""The infrared rangers in the order of the packet, each with its range in metres."""
BUTTONS = ("LFrPaw", "RFrPaw", "LBkPaw", "RBkPaw", "chin", "head", "frontback", "middleback", "rearback", "wireless")
PAN, TILT, NOD = (-1.536, 1.536), (-1.309, 0.0), (-0.262, 0.785)
OUTPUT_COUNT = 47
MAX_RANGE_MM = 10_000.0
"""Maximum plausible reading of an infrared ranger, in mm."""

_SENSOR_BOUNDS = (
    *((-1.0, MAX_RANGE_MM),) * 3,
    *((-200.0, 200.0),) * 3,
    *((-0.01, 1.5), (-50.0, 150.0), (0.0, 1e5), (0.0, 100.0), (-1e5, 1e5)),
)
_CAPACITY_MAH = 2200.0
WRAP_MS = 2**32
MAX_GAP_MS = 1000
"""Longest gap in ms over which odometry integrates; after a longer gap the movement is unknown."""


def is_known(state: WorldState) -> bool:
    """Return whether the sensors of this model are known; old versions of Tekkotsu do not send the model."""
    counts = (len(state.sensors), len(state.buttons), len(state.duties))
    return state.model in (MODEL, "") and counts == (len(_SENSOR_BOUNDS), len(BUTTONS), len(JOINTS))


def convert_state(state: WorldState) -> dict[str, Value]:
    """Return the sensor data under the keys of an observation; raise ``BadFrame`` if any value is out of bounds.

    A range is NaN if the sensor reads its maximum: nothing is in range.
    """
    joints = state.outputs[: len(JOINTS)]
    if len(joints) != len(JOINTS):
        raise BadFrame(f"an ERS-7 has {len(JOINTS)} joints, not {len(joints)}")
    _check_bounds(state.sensors, _SENSOR_BOUNDS)
    _check_bounds(joints, ((-math.tau, math.tau),) * len(joints))
    _check_bounds(state.buttons, ((-1.0, 10.0),) * len(state.buttons))
    _check_bounds(state.duties, ((-2.0, 2.0),) * len(state.duties))
    sensors = state.sensors
    found: dict[str, Value] = {}
    for (name, (_, far)), mm in zip(RANGES.items(), sensors, strict=False):
        found[f"range.{name}"] = math.nan if mm >= far * 1000.0 else max(mm, 0.0) / 1000.0
    found |= {"imu.ax": -sensors[3], "imu.ay": sensors[4], "imu.az": -sensors[5]}
    found |= {
        "power.level": min(max(sensors[6], 0.0), 1.0),
        "power.celsius": sensors[7],
        "power.volts": sensors[9],
        "power.amps": sensors[10] / 1000.0,
    }
    for name, pressed in zip(BUTTONS, state.buttons, strict=True):
        found[f"button.{name}"] = min(max(pressed, 0.0), 1.0)
    for name, position, duty in zip(JOINTS, joints, state.duties, strict=True):
        found[f"joint.{name}.pos"] = position
        found[f"joint.{name}.effort"] = min(max(duty, -1.0), 1.0)
    found |= {"ptz.tilt": joints[12], "ptz.pan": joints[13], "ptz.nod": joints[14]}
    return found


def make_state(values: Mapping[str, Value], joints: Sequence[float], dialect: str, t: int, frame: int) -> WorldState:
    """Return the world state of an ERS-7 with ``values`` and ``joints``; missing values are those of a dog at rest."""

    def number(key: str, default: float) -> float:
        return float(values.get(key, default))

    sensors = []
    for name, (near, far) in RANGES.items():
        metres = number(f"range.{name}", math.nan)
        sensors.append(1000.0 * (far if math.isnan(metres) else min(max(metres, near), far)))
    sensors += [-number("imu.ax", 0.0), number("imu.ay", 0.0), -number("imu.az", 9.81)]
    sensors += [number("power.level", 1.0), number("power.celsius", 30.0), _CAPACITY_MAH]
    sensors += [number("power.volts", 7.9), 1000.0 * number("power.amps", -1.2)]
    outputs = (*joints, *(0.0,) * (OUTPUT_COUNT - len(joints)))
    buttons = tuple(number(f"button.{name}", 0.0) for name in BUTTONS)
    model = "" if dialect == T2 else MODEL
    return WorldState(dialect, model, t, frame, outputs, tuple(sensors), buttons, (0.0,) * len(joints))


def _check_bounds(row: Sequence[float], bounds: Sequence[tuple[float, float]]) -> None:
    for value, (low, high) in zip(row, bounds, strict=True):
        if not low <= value <= high:  # NaN is never within bounds
            raise BadFrame(f"{value} is not between {low} and {high}")


class Odometry:
    """Converts the robot's wrapping time stamps to a steady time, and integrates the commanded velocity over it."""

    def __init__(self) -> None:
        self.t = 0.0
        self._pose = [0.0, 0.0, 0.0]
        self._newest: int | None = None

    def restart_interval(self) -> None:
        """Handle a lost link: the next time stamp starts a new interval."""
        self._newest = None

    def convert_time(self, t_ms: int) -> float:
        """Convert a time stamp, which must be close to the newest one, to seconds of the steady time."""
        if self._newest is None:
            return self.t
        return self.t + ((t_ms - self._newest + WRAP_MS // 2) % WRAP_MS - WRAP_MS // 2) / 1000.0

    def step(self, t_ms: int, vx: float, vy: float, wz: float) -> None:
        """Add the movement up to ``t_ms`` at these velocities."""
        elapsed = 0 if self._newest is None else (t_ms - self._newest) % WRAP_MS
        if self._newest is None and self.t == 0.0:
            self.t = t_ms / 1000.0
        self._newest = t_ms
        if elapsed > MAX_GAP_MS:
            return
        dt = elapsed / 1000.0
        self.t += dt
        x, y, yaw = self._pose
        cos, sin = math.cos(yaw), math.sin(yaw)
        self._pose = [x + (vx * cos - vy * sin) * dt, y + (vx * sin + vy * cos) * dt, yaw + wz * dt]

    def read_pose(self) -> dict[str, Value]:
        """Return the pose under the keys of an observation."""
        x, y, yaw = self._pose
        return {"odom.x": x, "odom.y": y, "odom.yaw": math.remainder(yaw, math.tau)}
