"""A simulated robot of any kind, built from its driver's description, to test behaviours without nodes and links.

It executes each action immediately, as its driver would report it, and has only the sensors of its kind.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from random import Random

from agents.context import Context
from agents.motion import MotionCapabilities
from agents.search import SearchAndApproach
from drivers.bittle.gait import GAITS, Velocity, select_gait
from drivers.reading import Action, Description, Frame, Observation, Value
from drivers.registry import describe
from sim.robots.camera import Camera
from sim.robots.dog import Motion
from sim.robots.scene import load_scene
from sim.robots.sensor import Sensors
from sim.robots.world import SUBSTEP_S, World

STEPS = 6
TICK = STEPS * SUBSTEP_S
LIT = 0.35
"""The range in metres of the light bumpers of a Create 2."""
TOUCH = 0.012
LENS: Mapping[str, float | str] = {"width": 208, "height": 160, "fps": 15, "fov_h_deg": 56.9, "fov_v_deg": 45.2}
Does = Callable[[Action], Action]


def filming(description: Description, fps: float = 15.0) -> Description:
    """Return the description with a camera added."""
    capabilities = {**description.capabilities, "camera": {**LENS, "fps": fps}}
    return replace(description, capabilities=capabilities, rates={**description.rates, "camera": fps})


def described(kind: str) -> Description:
    """Return the description of a robot of this kind that has a camera."""
    if kind == "sim":
        return describe(kind, {"robot": "dog1"})
    if kind == "create2":
        return filming(describe(kind, {"port": "/dev/ttyUSB0"}))
    if kind == "bittle":
        return filming(describe(kind, {"port": "/dev/ttyUSB0"}), 5.0)
    return filming(describe(kind, {"image_topic": "/image", "max_range": 3.5}), 10.0)


def clipped(description: Description) -> Does:
    """Return a function that clips an action to the limits of the description."""
    return lambda action: {
        k: min(max(v, description.limits[k][0]), description.limits[k][1]) for k, v in action.items()
    }


def quantised(description: Description, gaits: Mapping[str, Velocity] = GAITS) -> Does:
    """Return a function that replaces an action by the velocity of the nearest gait."""

    def does(action: Action) -> Action:
        wished = clipped(description)(action)
        _, done = select_gait(wished["base.vx"], wished["base.wz"], gaits)
        return {"base.vx": done.vx, "base.wz": done.wz}

    return does


class Roamer:
    """A robot that replaces the simulator's first dog; it executes each action after ``lag`` seconds."""

    def __init__(
        self, kind: str, seed: int, does: Does | None = None, lag: float = 0.1, description: Description | None = None
    ) -> None:
        self.description = description or described(kind)
        make = {"bittle": quantised}.get(kind, clipped)
        self.does = does or make(self.description)
        self.world = World(Random(seed), load_scene("three-dogs"))
        self.camera = Camera(Random(seed + 1), self.world)
        self.world.scatter(seed)
        self.world.place_target_at_random()
        self.dog = self.world.dogs["dog1"]
        self.dog.shape.unsafe_set_radius(self.description.radius)
        self.senses = Sensors(Random(seed + 2), self.world, self.dog)
        self.motion = MotionCapabilities(self.description)
        self.behaviour = SearchAndApproach({}, Random(seed + 3))
        self.behaviour.embody(self.motion)
        self.now = 0.0
        self.hardest = 0.0
        """The highest speed in m/s at which the robot has touched an object."""
        self.done: Action = {}
        self.reversals = 0
        self._kind = kind
        self._lag = deque([Motion()] * round(lag / TICK))
        self._speeds: deque[float] = deque([0.0] * 4, 4)
        self._frames = 0
        self._frame_at = 0.0
        self._was_touching = False
        self._reckoned = [0.0, 0.0, 0.0]

    @property
    def gap(self) -> float:
        """Return the distance in metres between the robot and the target."""
        target = self.world.target
        assert target is not None
        away = math.dist((target.x, target.y), (self.dog.x, self.dog.y))
        return away - target.radius - self.description.radius

    def sense(self) -> Mapping[str, Value]:
        """Return the values of the sensors that a robot of this kind has."""
        values: dict[str, Value] = dict(self.senses.values())
        if self._kind != "sim":
            values.pop("compass.heading")
        if self._kind == "bittle":
            values |= {f"odom.{axis}": value for axis, value in zip(("x", "y", "yaw"), self._reckoned, strict=True)}
        near, far = float(values["range.near"]), float(values["range.far"])
        if self._kind == "sim":
            return values
        values = {key: value for key, value in values.items() if not key.startswith("range.")}
        if self._kind == "create2":
            side = self.touched()
            values |= {"bump.left": side is not None and side >= 0.0, "bump.right": side is not None and side <= 0.0}
            values |= {f"lightbump.{name}.hit": near < LIT for name in ("center_left", "center_right")}
        elif "ranger" in self.description.capabilities:
            values["range.front"] = min((one for one in (near, far) if not math.isnan(one)), default=math.nan)
        return values

    def touched(self) -> float | None:
        """Return the bearing in radians (left is positive) of an object that the front half touches, or None."""
        dog, radius = self.dog, self.description.radius
        width, height = self.world.scene.width, self.world.scene.height
        others = [(d.x, d.y, 0.12) for d in self.world.dogs.values() if d is not dog]
        if self.world.target is not None:
            others.append((self.world.target.x, self.world.target.y, self.world.target.radius))
        ways = [(math.dist((x, y), (dog.x, dog.y)) - r, math.atan2(y - dog.y, x - dog.x)) for x, y, r in others]
        ways += [(dog.x, math.pi), (width - dog.x, 0.0), (dog.y, -math.pi / 2), (height - dog.y, math.pi / 2)]
        sides = [math.remainder(way - dog.heading, math.tau) for far, way in ways if far < radius + TOUCH]
        return min((side for side in sides if abs(side) < 1.7), key=abs, default=None)

    def live(self, act: Callable[[float], Action | None]) -> Action | None:
        """Run one tick: sense, observe, act."""
        for _ in range(STEPS):
            self.world.step()
            self.senses.sample()
        self.now += TICK
        is_touching = self.touched() is not None
        if is_touching and not self._was_touching:
            self.hardest = max(self.hardest, *self._speeds)
        self._was_touching = is_touching
        self._speeds.append(math.hypot(*self.dog.motion[:2]))
        frame = None
        if self.now - self._frame_at >= 1.0 / self.description.rates["camera"]:
            self._frames, self._frame_at = self._frames + 1, self.now
            frame = Frame(self._frames, 208, 160, self.camera.render_jpeg(self.dog), self.now)
        self.behaviour.look(Observation(self.now, self.now, self.sense(), frame=frame), self.now)
        action = act(self.now)
        wished = self.motion.remove_missing_axes(action or {"base.vx": 0.0, "base.vy": 0.0, "base.wz": 0.0})
        unknown = set(wished) - set(self.description.limits)
        assert not unknown, f"{self._kind} has no {unknown}"
        before, self.done = self.done, self.does(wished)
        self.motion.learn(wished, self.done)
        self.reversals += self.done.get("base.wz", 0.0) * before.get("base.wz", 0.0) < 0.0
        self._lag.append(Motion(*(self.done.get(key, 0.0) for key in ("base.vx", "base.vy", "base.wz"))))
        self._reckon()
        # ``drive`` applies the limits of an ERS-7, so it is not used here.
        self.dog.command = self._lag.popleft()
        return action

    def _reckon(self) -> None:
        """Integrate the executed actions into a pose estimate, like a dog without encoders."""
        x, y, yaw = self._reckoned
        distance = self.done.get("base.vx", 0.0) * TICK
        turned = math.remainder(yaw + self.done.get("base.wz", 0.0) * TICK, math.tau)
        self._reckoned = [x + distance * math.cos(yaw), y + distance * math.sin(yaw), turned]

    def find(self, limit: float) -> float | None:
        """Search until the behaviour has a cost, for at most ``limit`` seconds; return the cost."""
        while self.behaviour.cost is None and self.now < limit:
            self.live(self.behaviour.search)
        return self.behaviour.cost

    def reach(self, limit: float) -> bool:
        """Execute the task until it is done, for at most ``limit`` seconds; return whether it is done."""
        end = self.now + limit
        while self.now < end:
            if self.live(lambda now: self.behaviour.execute(Context(now))) is None:
                for _ in range(10):  # the robot comes to rest
                    self.live(lambda now: {"base.vx": 0.0, "base.vy": 0.0, "base.wz": 0.0})
                return True
        return False
