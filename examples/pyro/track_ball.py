"""A brain that turns towards a red ball; run ``python examples/pyro/track_ball.py [--host ROBOT]``."""

from __future__ import annotations

from drivers.pyro.brain import Brain, Engine

RED = (190, 32, 42)
TOLERANCE = 55
LEAST = 12
"""Smallest area of a ball in pixels."""


class TrackBall(Brain):
    """Turns until the ball is visible, and then keeps it in the middle of the picture."""

    def setup(self) -> None:
        """Add filters that find red pixels."""
        self.cam = self.robot.camera[0]
        self.cam.addFilter("match", *RED, TOLERANCE)
        self.cam.addFilter("blobify", 0, 255, 255, 0, 1, 1, 1)

    def destroy(self) -> None:
        """Remove the filters."""
        self.cam.clearFilters()

    def step(self) -> None:
        """Turn towards the largest red area, or, if there is none, continue to turn."""
        results = self.cam.filterResults
        if len(results) > 1 and len(results[-1]) > 0:  # both filters have run
            x1, y1, x2, y2, area = results[-1][0]
            if area > LEAST:
                off = (x1 + x2) / 2 - self.cam.width / 2
                return self.robot.rotate(0.0 if abs(off) < 0.05 * self.cam.width else -0.5 * off / self.cam.width)
        self.robot.rotate(0.3)


def INIT(engine: Engine) -> Brain:
    """Return the brain of this file."""
    engine.robot.requires("camera")
    return TrackBall("TrackBall", engine)


if __name__ == "__main__":
    from lab import main

    main(INIT, "Turn to a red ball.")
