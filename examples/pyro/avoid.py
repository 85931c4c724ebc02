"""A brain that wanders and avoids obstacles; run ``python examples/pyro/avoid.py [--host ROBOT]``."""

from __future__ import annotations

import math

from drivers.pyro.brain import Brain, Engine

NEAR, FREE = 0.55, 0.9
"""Distance in metres at which the robot turns away, and free distance in metres at which it continues."""
CRUISE, TURN, SWING = 0.7, 0.4, 0.45
"""Speeds ahead, when turning away and when swinging, as fractions of the robot's limits."""


class Avoid(Brain):
    """Drives ahead and swings, because an AIBO measures only straight ahead; turns away from obstacles."""

    def setup(self) -> None:
        """Reset the state."""
        self.side = 0
        self.more = 0
        self.bumps = 0

    def step(self) -> None:
        """Read the range ahead, and decide."""
        robot = self.robot
        if robot.hasA("bumper") and any(robot.bumper[0].value):
            self.bumps = 8
        if self.bumps:
            self.bumps -= 1
            return robot.move(-0.3, 0.0) if self.bumps > 4 else robot.move(0.0, TURN)
        ahead = min((one.distance("M") for one in robot.range["front-all"]), default=math.inf)
        if self.side == 0 and ahead < NEAR:
            # The obstacle is on the side of the swing, so turn to the other side.
            self.side = -1 if math.sin(self.stepCount * 0.5) > 0 else 1
        if self.side:
            self.more = 5 if ahead < FREE else self.more - 1
            if self.more > 0:
                return robot.move(0.0, self.side * TURN)
            self.side = 0
        robot.move(CRUISE, SWING * math.cos(self.stepCount * 0.5))


def INIT(engine: Engine) -> Brain:
    """Return the brain of this file."""
    engine.robot.requires("range-sensor")
    return Avoid("Avoid", engine)


if __name__ == "__main__":
    from lab import main

    main(INIT, "Wander about without hitting anything.")
