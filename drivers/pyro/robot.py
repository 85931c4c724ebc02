"""Pyro's robot interface of 2011 over any current driver.

All calls are synchronous.  On the reactor's thread they call the driver directly; for another thread pass
``partial(blockingCallFromThread, reactor)`` as ``call``.

The robot is not part of a team: its commands have the lowest token, so a robot that has obeyed a team refuses them
(``StaleCommand``). The robot stops half a second after the last call of its brain. While its link is lost or its
motors are off, motion commands are ignored and the reason is logged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from drivers.driver import Driver, Permit
from drivers.errors import NotEnabled, Unsupported, UsageError
from drivers.pyro.camera import Camera
from drivers.pyro.device import Battery, Device, Ptz, SensorArray, make_bumper, make_ranger
from drivers.reading import Observation, Value

TOKEN = 1
TTL_S = 0.5
"""Seconds after the brain's last move or update after which the robot stops."""
FEATURES = {
    "continuous-movement": "base2d",
    "range-sensor": "ranger",
    "odometry": "odometry",
    "mono-sound": "sound",
    "visual-feedback": "leds",
}
"""The capability of each feature, by the name of the feature in brains."""
RANGERS = ("ir", "sonar", "laser")
LEGS = {"left front": "LFr", "right front": "RFr", "left back": "LBk", "right back": "RBk"}
JOINTS = {"rotator": "rotor", "rotor": "rotor", "elevator": "elvtr", "knee": "knee"}
HEAD_JOINTS = {"head tilt": "NECK:tilt", "head pan": "NECK:pan", "head nod": "NECK:nod", "head roll": "NECK:nod"}
TAIL_JOINTS = {"tail tilt": "TAIL:tilt", "tail pan": "TAIL:pan", "mouth": "MOUTH"}
RunFunction = Callable[[Callable[[], Any]], Any]


def run_directly(call: Callable[[], Any]) -> Any:
    """Call ``call`` in this thread, the reactor's, and do not wait for asynchronous results."""
    return call()


class PyroRobot:
    """One robot; ``clock`` is the clock of its driver.

    ``call`` runs a function on the driver's thread and returns its result.  Speeds are fractions of the robot's limits,
    -1 to 1: ahead, to the left and counter-clockwise are positive.
    """

    log = Logger()

    def __init__(self, driver: Driver, clock: IReactorTime, call: RunFunction = run_directly) -> None:
        self.driver = driver
        self.type = driver.description.kind
        self.radius = driver.description.radius
        self.timestamp = 0.0
        self.stall = 0
        self.x = self.y = self.z = self.th = self.thr = 0.0
        self._clock = clock
        self._call = call
        self._devices: dict[str, list[Device]] = {}
        self._range: Device | None = None
        self._shares = {"base.vx": 0.0, "base.vy": 0.0, "base.wz": 0.0}
        self._values: Mapping[str, Value] = {}
        self._is_standing = False
        self._pose = self._origin = (0.0, 0.0, 0.0)
        self._pose_at_origin = (0.0, 0.0, 0.0)

    # -- the link ---------------------------------------------------------------------------------------------------

    def connect(self) -> Any:
        """Open the link and switch the motors on; on the reactor's thread, return a Deferred that fires when done.

        If the link is already open, for example after an emergency stop at the robot, only switch the motors on.
        """
        if self.driver.state not in ("idle", "closed"):
            return self._call(self.driver.enable)
        return self._call(lambda: self.driver.connect().addCallback(lambda _: self._on_connected()))

    def disconnect(self) -> Any:
        """Stop the robot, and close the link."""
        return self._call(self.driver.disconnect)

    def _on_connected(self) -> Deferred[bool]:
        self._refresh()
        return self.driver.enable()

    # -- motion -----------------------------------------------------------------------------------------------------

    def move(self, translate: float, rotate: float) -> None:
        """Drive and turn at these fractions of the robot's speed."""
        self._set_shares({"base.vx": translate, "base.wz": rotate})

    def translate(self, share: float) -> None:
        """Drive ahead (to 1) or back (to -1); the turn rate stays."""
        self._set_shares({"base.vx": share})

    def rotate(self, share: float) -> None:
        """Turn left (to 1) or right (to -1); the speed stays."""
        self._set_shares({"base.wz": share})

    def strafe(self, share: float) -> None:
        """Drive to the left (to 1) or to the right (to -1); raise ``Unsupported`` if the robot cannot."""
        if "base.vy" not in self.driver.description.limits:
            raise Unsupported("this robot cannot walk sideways")
        self._set_shares({"base.vy": share})

    def motors(self, left: float, right: float) -> None:
        """Turn the left and the right wheel at these fractions."""
        self.move((right + left) / 2.0, (right - left) / 2.0)

    def stop(self) -> None:
        """Stand still."""
        self._shares = dict.fromkeys(self._shares, 0.0)
        self._call(self.driver.stop)

    def _set_shares(self, shares: Mapping[str, float]) -> None:
        for share in shares.values():
            if isinstance(share, bool) or not isinstance(share, int | float) or not math.isfinite(share):
                raise UsageError(f"a speed must be a number from -1 to 1, not {share!r}")
        self._shares |= {key: max(-1.0, min(1.0, float(share))) for key, share in shares.items()}
        self._call(self._send_action)

    def _send_action(self) -> None:
        action = {}
        for key, share in self._shares.items():
            if key in self.driver.description.limits:
                low, high = self.driver.description.limits[key]
                action[key] = share * high if share > 0.0 else -share * low
        try:
            self.driver.act(action, Permit(TOKEN, self._clock.seconds() + TTL_S))
        except NotEnabled as error:
            # The link is lost or the motors are off.  The motion does not resume by itself.
            self._shares = dict.fromkeys(self._shares, 0.0)
            if not self._is_standing:
                self.log.warn("motion command ignored: {error}", error=error)
            self._is_standing = True
        else:
            self._is_standing = False

    # -- sensors ----------------------------------------------------------------------------------------------------

    def update(self) -> None:
        """Read the newest sensor values and prolong the current motion."""
        self._call(self._refresh)
        if any(self._shares.values()):
            self._call(self._send_action)

    def _refresh(self) -> None:
        seen = self.driver.observe()
        if seen is None:
            return
        self.timestamp = seen.t_host
        values = self._values = seen.values
        self.stall = int(
            any(value is True and key.startswith(("bump.", "stall.l", "stall.r")) for key, value in values.items())
        )
        self._update_pose()
        if not self._devices:
            self._create_devices(seen)
        for devices in self._devices.values():
            for device in devices:
                if device.active:
                    device.update(values, seen.t_host)
                    if isinstance(device, Camera):
                        device.process_frame(seen.frame)

    def _update_pose(self) -> None:
        x, y, yaw = self._pose = self._read_odometry()
        x0, y0, yaw0 = self._origin
        x1, y1, yaw1 = self._pose_at_origin
        turn = yaw1 - yaw0
        self.x = x1 + math.cos(turn) * (x - x0) - math.sin(turn) * (y - y0)
        self.y = y1 + math.sin(turn) * (x - x0) + math.cos(turn) * (y - y0)
        self.thr = (yaw + turn) % math.tau
        self.th = math.degrees(self.thr)

    def _read_odometry(self) -> tuple[float, float, float]:
        x, y, yaw = (float(self._values.get(f"odom.{axis}", 0.0)) for axis in ("x", "y", "yaw"))
        return x, y, yaw

    def localize(self, x: float = 0.0, y: float = 0.0, thr: float = 0.0) -> None:
        """Set the current pose to (x, y) in metres and ``thr`` in radians."""
        self._origin, self._pose_at_origin = self._pose, (x, y, thr)
        self._update_pose()

    # -- devices ----------------------------------------------------------------------------------------------------

    @property
    def builtinDevices(self) -> list[str]:
        """The devices of the robot; all of them start with its first observation."""
        return sorted(self._devices)

    @property
    def devices(self) -> list[str]:
        """The types of the started devices."""
        return sorted(kind for kind, rows in self._devices.items() if any(one.active for one in rows))

    def getDevices(self) -> list[str]:
        """Return ``devices``."""
        return self.devices

    def getSupportedDevices(self) -> list[str]:
        """Return ``builtinDevices``."""
        return self.builtinDevices

    def getDevice(self, kind: str, index: int = 0) -> Device:
        """Return the device of this type."""
        return self._find_devices(kind)[index]

    def startDevice(self, name: str, **_options: object) -> Device:
        """Start updating a device again; a number after its type is ignored (``camera0``)."""
        device = self._find_devices(name.rstrip("0123456789"))[0]
        device.active, device.state = 1, "started"
        return device

    def removeDevice(self, kind: str, index: int | None = None) -> None:
        """Stop updating a device; it keeps its last values."""
        for device in self._find_devices(kind.rstrip("0123456789"))[slice(index, None if index is None else index + 1)]:
            device.active, device.state = 0, "stopped"

    @property
    def supportedFeatures(self) -> list[str]:
        """The features of the robot under their names in brains."""
        return [name for name, capability in FEATURES.items() if capability in self.driver.description.capabilities]

    def supports(self, feature: str) -> bool:
        """Return whether the robot has ``feature``."""
        return feature in self.supportedFeatures

    def hasA(self, kind: str) -> int:
        """Return 1 if a device of this type is started, else 0."""
        return int(kind in self.devices or (kind == "range" and self._range is not None))

    def requires(self, wanted: str | Sequence[str]) -> int:
        """Return 1 if the robot has all of these features and devices; raise ``ImportError`` with the missing ones."""
        names = [wanted] if isinstance(wanted, str) else list(wanted)
        lacking = [name for name in names if not (self.supports(name) or self.hasA(name))]
        if lacking:
            raise ImportError(f"this robot ({self.type}) has no {', '.join(lacking)}")
        return 1

    def setRangeSensor(self, kind: str, index: int = 0) -> None:
        """Make this device ``robot.range``."""
        self._range = self._find_devices(kind)[index]

    @property
    def range(self) -> SensorArray:
        """The range sensor, with readings from the left: ``robot.range["front"]``, ``robot.range[0]``."""
        if not isinstance(self._range, SensorArray):
            raise AttributeError(f"this robot ({self.type}) has no range sensor; it has {self._format_device_names()}")
        return self._range

    def __getattr__(self, name: str) -> list[Any]:
        """Return the started devices of a type, as in ``robot.camera[0]``; ``AttributeError`` lists the known types."""
        if name.startswith("_") or name not in self._devices:
            raise AttributeError(
                f"this robot has no {name}"
                + ("" if name.startswith("_") else f"; it has {self._format_device_names()}")
            )
        return list(self._devices[name])

    def _find_devices(self, kind: str) -> list[Device]:
        if kind == "range" and self._range is not None:
            return [self._range]
        if kind not in self._devices:
            raise AttributeError(f"this robot ({self.type}) has no {kind}; it has {self._format_device_names()}")
        return self._devices[kind]

    def _format_device_names(self) -> str:
        return ", ".join(sorted(self._devices)) or "no devices before it is connected"

    def _create_devices(self, seen: Observation) -> None:
        description = self.driver.description
        found: list[Device | None] = [make_ranger(description, seen.values), make_bumper(description, seen.values)]
        if "power" in description.capabilities:
            found.append(Battery("battery"))
        if "odometry" in description.capabilities:
            found.append(Device("position"))
        camera = description.capabilities.get("camera")
        if camera is not None:
            found.append(Camera(int(float(camera.get("width", 0))), int(float(camera.get("height", 0)))))
        if "look" in description.skills:
            found.append(Ptz(self._move_head, description.capabilities.get("ptz", {})))
        self._devices = {device.type: [device] for device in found if device is not None}
        self._range = next((self._devices[kind][0] for kind in RANGERS if kind in self._devices), None)

    # -- AIBO -------------------------------------------------------------------------------------------------------

    def getJoint(self, name: str) -> tuple[float, float]:
        """Return a joint's angle in radians and its effort: ``left front leg knee``, ``head pan``, or its key."""
        known = [key[6:-4] for key in self._values if key.startswith("joint.") and key.endswith(".pos")]
        words = name.replace(" leg ", " ")
        side, _, joint = words.rpartition(" ")
        found = {**HEAD_JOINTS, **TAIL_JOINTS}.get(name) or (
            f"{LEGS[side]}:{JOINTS.get(joint, joint)}" if side in LEGS else name
        )
        if found not in known:
            raise AttributeError(f"unknown joint {name!r}; known are {', '.join(known) or 'none'}")
        effort = self._values.get(f"joint.{found}.effort", 0.0)
        return float(self._values[f"joint.{found}.pos"]), float(effort)

    def getButton(self, name: str) -> float:
        """Return the pressure on a button, 0 to 1: ``chin``, ``head``, ``frontback``."""
        return self._read_value(f"button.{name}", "button.", name)

    def getSensor(self, name: str) -> float:
        """Return a sensor value: ``ir near`` (metres), ``accel x`` (m/s2), ``power``, or any key of an observation."""
        words = name.split()
        if len(words) == 2 and words[0] == "ir":
            return self._read_value(f"range.{words[1]}", "range.", name)
        if len(words) == 2 and words[0].startswith("accel"):
            return self._read_value(f"imu.a{words[1]}", "imu.", name)
        return self._read_value("power.level" if name == "power" else name, "", name)

    def playSound(self, name: str) -> Any:
        """Play a sound: one of the robot's skills, or a file on its memory stick."""
        if name in self.driver.description.skills:
            return self._invoke(name)
        return self._invoke("play", sound=name)

    def runMotion(self, name: str) -> Any:
        """Run one of the robot's skills."""
        return self._invoke(name)

    def setWalk(self, name: str) -> Any:
        """Choose a walk; raise ``Unsupported`` if the robot has only one."""
        return self._invoke("walk", name=name)

    def _read_value(self, key: str, prefix: str, name: str) -> float:
        value = self._values.get(key)
        if not isinstance(value, int | float):
            known = ", ".join(sorted(one.removeprefix(prefix) for one in self._values if one.startswith(prefix)))
            raise AttributeError(f"unknown sensor {name!r}; known are {known or 'none'}")
        return float(value)

    def _move_head(self, joints: Mapping[str, float]) -> None:
        self._invoke("look", **joints)

    def _invoke(self, skill: str, **arguments: float | str) -> Any:
        known = self.driver.description.skills
        if skill not in known:
            raise Unsupported(f"this robot has no skill {skill!r}; its skills are {', '.join(known) or 'none'}")
        return self._call(lambda: self.driver.invoke(skill, **arguments).addErrback(self._on_failed, skill))

    def _on_failed(self, failure: Any, name: str) -> None:
        self.log.warn("{name}: {reason}", name=name, reason=failure.getErrorMessage())
