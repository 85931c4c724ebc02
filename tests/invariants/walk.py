"""The behaviour in the workload of tasks, and its robot, which moves on a line."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping

from twisted.internet.defer import Deferred, succeed

from agents.behaviour import STAND
from agents.context import Context
from drivers.driver import Permit
from drivers.gate import Gate
from drivers.reading import Action, Description, Observation
from middleware.entangled.clock import HeapClock


class Walk:
    """Walk along a line to a target; the cost is rounded to quarters, so equal costs are frequent."""

    def __init__(self, parameters: Mapping[str, float | str], rng: random.Random) -> None:
        self._target = float(parameters["target"])
        self._place: float | None = None
        self._drift = 0.0
        self._start = 1.0

    def look(self, seen: Observation, now: float) -> None:
        """Read the robot's position and the drift of the target."""
        self._place, self._drift = float(seen.values["place"]), float(seen.values["drift"])

    @property
    def cost(self) -> float | None:
        """Return the distance, rounded to quarters."""
        return None if self._place is None else round(4.0 * abs(self._target - self._place) + self._drift) / 4.0

    @property
    def is_safe(self) -> bool:
        """Return False at some positions, at which the robot must not be stopped."""
        return self._place is None or round(5.0 * self._place) % 5 != 0

    def search(self, now: float) -> Action:
        """Stand still."""
        return STAND

    def hold(self, now: float) -> Action:
        """Stand still."""
        return STAND

    def execute(self, context: Context) -> Action | None:
        """Walk to the target."""
        assert self._place is not None
        way = self._target - self._place
        return None if abs(way) < 0.1 else {**STAND, "base.vx": 0.8 if way > 0 else -0.8}


class Robot:
    """A driver of a robot on a line."""

    def __init__(self, clock: HeapClock, place: float) -> None:
        self.description = Description("walker", "", {}, {"base.vx": (-1.0, 1.0)}, 0.1)
        self.state = "ready"
        self.place = place
        self.drift = 0.0
        self._clock = clock
        self._gate = Gate()
        self._speed = 0.0
        self._seen: Callable[[Observation], None] = lambda seen: None
        self._is_on = False

    @property
    def token(self) -> int:
        """Return the highest token that the robot has accepted."""
        return self._gate.token or 0

    def connect(self) -> Deferred[None]:
        """Start sending observations."""
        self._is_on = True
        self._clock.callLater(0.1, self._live)
        return succeed(None)

    def enable(self) -> Deferred[bool]:
        """Enable the motors."""
        return succeed(True)

    def disconnect(self) -> Deferred[None]:
        """End the connection."""
        self._is_on = False
        return succeed(None)

    def subscribe(self, seen: Callable[[Observation], None]) -> Callable[[], None]:
        """Subscribe to the observations."""
        self._seen = seen
        return lambda: None

    def observe(self) -> None:
        """Do nothing, because observations are pushed."""

    def stop(self) -> None:
        """Stop the robot."""
        self._speed = 0.0

    def act(self, action: Action, permit: Permit) -> Action:
        """Walk until the permit ends."""
        self._gate.admit(permit, self._clock.seconds())
        self._speed = action["base.vx"]
        return action

    def _live(self) -> None:
        if self._is_on:
            self._clock.callLater(0.1, self._live)
            if self._gate.is_motion_over(self._clock.seconds()):
                self._speed = 0.0
            self.place += 0.1 * self._speed
            now = self._clock.seconds()
            self._seen(Observation(now, now, {"place": self.place, "drift": self.drift}))


def restarted(robot: Robot, clock: HeapClock) -> Robot:
    """Return the robot as its restarted node sees it; the gate, and so the highest token, is kept."""
    again = Robot(clock, robot.place)
    again._gate = robot._gate
    return again
