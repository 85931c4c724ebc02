"""PyroRobot: one robot as brains of 2011 drove it, over any driver of today.

Thin and synchronous: each call does what it says and returns.  On the reactor's thread it calls the driver directly;
for another thread it is made with ``partial(blockingCallFromThread, reactor)`` as its ``call``.

It is a robot of a lab, and of no team: it moves under the lowest token, so a robot that has obeyed a team refuses it
(``StaleCommand``), and stops half a second after its brain has fallen silent.  While its link is lost, or its motors
are off, it stands whatever it is told, and the log says why.
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
from drivers.pyro.device import Battery, Device, Ptz, Rows, bumper_of, ranger_of
from drivers.reading import Observation, Value

TOKEN = 1
TTL_S = 0.5
"""A brain that does not move or update for so long has its robot stopped."""
FEATURES = {
    "continuous-movement": "base2d",
    "range-sensor": "ranger",
    "odometry": "odometry",
    "mono-sound": "sound",
    "visual-feedback": "leds",
}
"""What brains call a feature, and the capability that it is."""
RANGERS = ("ir", "sonar", "laser")
LEGS = {"left front": "LFr", "right front": "RFr", "left back": "LBk", "right back": "RBk"}
JOINTS = {"rotator": "rotor", "rotor": "rotor", "elevator": "elvtr", "knee": "knee"}
PLACES = {"head tilt": "NECK:tilt", "head pan": "NECK:pan", "head nod": "NECK:nod", "head roll": "NECK:nod"}
TAILS = {"tail tilt": "TAIL:tilt", "tail pan": "TAIL:pan", "mouth": "MOUTH"}
Call = Callable[[Callable[[], Any]], Any]


def here(call: Callable[[], Any]) -> Any:
    """Call it on the reactor's thread: what takes its time goes on afterwards, and is not waited for."""
    return call()


class PyroRobot:
    """One robot; ``clock`` is its driver's.

    ``call`` calls a function where the driver lives, and returns what that gives in the end.  Speeds are shares of
    the robot's own, -1 to 1: ahead, to the left and counter-clockwise are positive.
    """

    log = Logger()

    def __init__(self, driver: Driver, clock: IReactorTime, call: Call = here) -> None:
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
        self._stands = False
        self._pose = self._origin = (0.0, 0.0, 0.0)
        self._at_origin = (0.0, 0.0, 0.0)

    # -- the link ---------------------------------------------------------------------------------------------------

    def connect(self) -> Any:
        """Open the link and switch the motors on; on the reactor's thread it returns a Deferred that fires then.

        Where the link is open already, as after somebody pressed the robot's own switch, only the motors are.
        """
        if self.driver.state not in ("idle", "closed"):
            return self._call(self.driver.enable)
        return self._call(lambda: self.driver.connect().addCallback(lambda _: self._on_connected()))

    def disconnect(self) -> Any:
        """Stop, and close the link."""
        return self._call(self.driver.disconnect)

    def _on_connected(self) -> Deferred[bool]:
        self._refresh()
        return self.driver.enable()

    # -- motion -----------------------------------------------------------------------------------------------------

    def move(self, translate: float, rotate: float) -> None:
        """Walk and turn with these shares of the robot's speed."""
        self._go({"base.vx": translate, "base.wz": rotate})

    def translate(self, share: float) -> None:
        """Walk ahead (to 1) or back (to -1); go on turning as before."""
        self._go({"base.vx": share})

    def rotate(self, share: float) -> None:
        """Turn left (to 1) or right (to -1); go on walking as before."""
        self._go({"base.wz": share})

    def strafe(self, share: float) -> None:
        """Walk to the left (to 1) or to the right (to -1); ``Unsupported`` where the robot cannot."""
        if "base.vy" not in self.driver.description.limits:
            raise Unsupported("this robot cannot walk sideways")
        self._go({"base.vy": share})

    def motors(self, left: float, right: float) -> None:
        """Turn the left and the right wheel with these shares."""
        self.move((right + left) / 2.0, (right - left) / 2.0)

    def stop(self) -> None:
        """Stand still."""
        self._shares = dict.fromkeys(self._shares, 0.0)
        self._call(self.driver.stop)

    def _go(self, shares: Mapping[str, float]) -> None:
        for share in shares.values():
            if isinstance(share, bool) or not isinstance(share, int | float) or not math.isfinite(share):
                raise UsageError(f"a speed is a share from -1 to 1, not {share!r}")
        self._shares |= {key: max(-1.0, min(1.0, float(share))) for key, share in shares.items()}
        self._call(self._act)

    def _act(self) -> None:
        wished = {}
        for key, share in self._shares.items():
            if key in self.driver.description.limits:
                low, high = self.driver.description.limits[key]
                wished[key] = share * high if share > 0.0 else -share * low
        try:
            self.driver.act(wished, Permit(TOKEN, self._clock.seconds() + TTL_S))
        except NotEnabled as error:
            # The link is being opened again, or its own switch stopped it.  It does not start again by itself.
            self._shares = dict.fromkeys(self._shares, 0.0)
            if not self._stands:
                self.log.warn("the robot stands: {error}", error=error)
            self._stands = True
        else:
            self._stands = False

    # -- what it feels ----------------------------------------------------------------------------------------------

    def update(self) -> None:
        """Take in the newest that the robot feels, and go on moving as before: whoever updates is alive."""
        self._call(self._refresh)
        if any(self._shares.values()):
            self._call(self._act)

    def _refresh(self) -> None:
        seen = self.driver.observe()
        if seen is None:
            return
        self.timestamp = seen.t_host
        values = self._values = seen.values
        self.stall = int(
            any(value is True and key.startswith(("bump.", "stall.l", "stall.r")) for key, value in values.items())
        )
        self._reckon()
        if not self._devices:
            self._start(seen)
        for devices in self._devices.values():
            for device in devices:
                if device.active:
                    device.update(values, seen.t_host)
                    if isinstance(device, Camera):
                        device.see(seen.frame)

    def _reckon(self) -> None:
        x, y, yaw = self._pose = self._odometry()
        x0, y0, yaw0 = self._origin
        x1, y1, yaw1 = self._at_origin
        turn = yaw1 - yaw0
        self.x = x1 + math.cos(turn) * (x - x0) - math.sin(turn) * (y - y0)
        self.y = y1 + math.sin(turn) * (x - x0) + math.cos(turn) * (y - y0)
        self.thr = (yaw + turn) % math.tau
        self.th = math.degrees(self.thr)

    def _odometry(self) -> tuple[float, float, float]:
        x, y, yaw = (float(self._values.get(f"odom.{axis}", 0.0)) for axis in ("x", "y", "yaw"))
        return x, y, yaw

    def localize(self, x: float = 0.0, y: float = 0.0, thr: float = 0.0) -> None:
        """Count from here on that the robot is at (x, y) in metres, and looks to ``thr`` radians."""
        self._origin, self._at_origin = self._pose, (x, y, thr)
        self._reckon()

    # -- devices ----------------------------------------------------------------------------------------------------

    @property
    def builtinDevices(self) -> list[str]:
        """The devices that the robot has; all of them are started when it is heard first."""
        return sorted(self._devices)

    @property
    def devices(self) -> list[str]:
        """The types of the devices that are started."""
        return sorted(kind for kind, rows in self._devices.items() if any(one.active for one in rows))

    def getDevices(self) -> list[str]:
        """As ``devices``."""
        return self.devices

    def getSupportedDevices(self) -> list[str]:
        """As ``builtinDevices``."""
        return self.builtinDevices

    def getDevice(self, kind: str, index: int = 0) -> Device:
        """The device of this type."""
        return self._having(kind)[index]

    def startDevice(self, name: str, **_options: object) -> Device:
        """Have a device of the robot followed again; a number behind its type is passed over (``camera0``)."""
        device = self._having(name.rstrip("0123456789"))[0]
        device.active, device.state = 1, "started"
        return device

    def removeDevice(self, kind: str, index: int | None = None) -> None:
        """Follow it no more: what it told last stands."""
        for device in self._having(kind.rstrip("0123456789"))[slice(index, None if index is None else index + 1)]:
            device.active, device.state = 0, "stopped"

    @property
    def supportedFeatures(self) -> list[str]:
        """What the robot can, in the words of brains."""
        return [name for name, capability in FEATURES.items() if capability in self.driver.description.capabilities]

    def supports(self, feature: str) -> bool:
        """Whether it can."""
        return feature in self.supportedFeatures

    def hasA(self, kind: str) -> int:
        """1 where a device of this type is started, else 0."""
        return int(kind in self.devices or (kind == "range" and self._range is not None))

    def requires(self, wanted: str | Sequence[str]) -> int:
        """1 where the robot has all of these features and devices; raises ``ImportError``, which names what lacks."""
        names = [wanted] if isinstance(wanted, str) else list(wanted)
        lacking = [name for name in names if not (self.supports(name) or self.hasA(name))]
        if lacking:
            raise ImportError(f"this robot ({self.type}) has no {', '.join(lacking)}")
        return 1

    def setRangeSensor(self, kind: str, index: int = 0) -> None:
        """Have ``robot.range`` be this device."""
        self._range = self._having(kind)[index]

    @property
    def range(self) -> Rows:
        """The range sensor, in readings from the left: ``robot.range["front"]``, ``robot.range[0]``."""
        if not isinstance(self._range, Rows):
            raise AttributeError(f"this robot ({self.type}) has no range sensor; it has {self._known()}")
        return self._range

    def __getattr__(self, name: str) -> list[Any]:
        """The started devices of a type: ``robot.camera[0]``; raises ``AttributeError`` with those there are."""
        if name.startswith("_") or name not in self._devices:
            raise AttributeError(
                f"this robot has no {name}" + ("" if name.startswith("_") else f"; it has {self._known()}")
            )
        return list(self._devices[name])

    def _having(self, kind: str) -> list[Device]:
        if kind == "range" and self._range is not None:
            return [self._range]
        if kind not in self._devices:
            raise AttributeError(f"this robot ({self.type}) has no {kind}; it has {self._known()}")
        return self._devices[kind]

    def _known(self) -> str:
        return ", ".join(sorted(self._devices)) or "nothing before it is connected"

    def _start(self, seen: Observation) -> None:
        description = self.driver.description
        found: list[Device | None] = [ranger_of(description, seen.values), bumper_of(description, seen.values)]
        if "power" in description.capabilities:
            found.append(Battery("battery"))
        if "odometry" in description.capabilities:
            found.append(Device("position"))
        camera = description.capabilities.get("camera")
        if camera is not None:
            found.append(Camera(int(float(camera.get("width", 0))), int(float(camera.get("height", 0)))))
        if "look" in description.skills:
            found.append(Ptz(self._look, description.capabilities.get("ptz", {})))
        self._devices = {device.type: [device] for device in found if device is not None}
        self._range = next((self._devices[kind][0] for kind in RANGERS if kind in self._devices), None)

    # -- what an AIBO has beside --------------------------------------------------------------------------------------

    def getJoint(self, name: str) -> tuple[float, float]:
        """Where a joint stands in radians, and its effort: ``left front leg knee``, ``head pan``, or by its key."""
        known = [key[6:-4] for key in self._values if key.startswith("joint.") and key.endswith(".pos")]
        words = name.replace(" leg ", " ")
        side, _, joint = words.rpartition(" ")
        found = {**PLACES, **TAILS}.get(name) or (f"{LEGS[side]}:{JOINTS.get(joint, joint)}" if side in LEGS else name)
        if found not in known:
            raise AttributeError(f"no joint is called {name!r}; there are {', '.join(known) or 'none'}")
        effort = self._values.get(f"joint.{found}.effort", 0.0)
        return float(self._values[f"joint.{found}.pos"]), float(effort)

    def getButton(self, name: str) -> float:
        """How hard a button is pressed, 0 to 1: ``chin``, ``head``, ``frontback``."""
        return self._told(f"button.{name}", "button.", name)

    def getSensor(self, name: str) -> float:
        """What a sensor tells: ``ir near`` (metres), ``accel x`` (m/s2), ``power``, or any key of an observation."""
        words = name.split()
        if len(words) == 2 and words[0] == "ir":
            return self._told(f"range.{words[1]}", "range.", name)
        if len(words) == 2 and words[0].startswith("accel"):
            return self._told(f"imu.a{words[1]}", "imu.", name)
        return self._told("power.level" if name == "power" else name, "", name)

    def playSound(self, name: str) -> Any:
        """Play a sound: one that the robot knows, or a file on its stick."""
        if name in self.driver.description.skills:
            return self._do(name)
        return self._do("play", sound=name)

    def runMotion(self, name: str) -> Any:
        """Have it do one of its skills."""
        return self._do(name)

    def setWalk(self, name: str) -> Any:
        """Choose another walk; ``Unsupported`` where the robot has one only."""
        return self._do("walk", name=name)

    def _told(self, key: str, prefix: str, name: str) -> float:
        value = self._values.get(key)
        if not isinstance(value, int | float):
            known = ", ".join(sorted(one.removeprefix(prefix) for one in self._values if one.startswith(prefix)))
            raise AttributeError(f"nothing is called {name!r}; there are {known or 'none'}")
        return float(value)

    def _look(self, joints: Mapping[str, float]) -> None:
        self._do("look", **joints)

    def _do(self, skill: str, **arguments: float | str) -> Any:
        known = self.driver.description.skills
        if skill not in known:
            raise Unsupported(f"this robot has no skill {skill!r}; it knows {', '.join(known) or 'none'}")
        return self._call(lambda: self.driver.invoke(skill, **arguments).addErrback(self._not_done, skill))

    def _not_done(self, failure: Any, name: str) -> None:
        self.log.warn("{name}: {reason}", name=name, reason=failure.getErrorMessage())
