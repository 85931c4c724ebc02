"""Tests of the brains in ``examples/pyro``, with the AIBO driver and its emulator in a simulated world."""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from drivers.pyro.brain import Engine
from drivers.pyro.robot import PyroRobot
from sim.robots.scene import FOOTPRINT_RADIUS_M

EXAMPLES = Path(__file__).parents[2] / "examples" / "pyro"
STEP_S = 0.008


class BrainTests(SynchronousTestCase):
    def setUp(self) -> None:
        """Import the examples, which are not in a package."""
        sys.path.insert(0, str(EXAMPLES))
        self.addCleanup(sys.path.remove, str(EXAMPLES))
        self.lab, self.avoid, self.track_ball = (
            importlib.import_module(name) for name in ("lab", "avoid", "track_ball")
        )

    def played(
        self,
        init: Any,
        seed: int,
        seconds: float,
        watch: Callable[[Any, float], None],
        arrange: Callable[[Any], None] = lambda pen: None,
    ) -> Any:
        """Run a brain in a pen that ``arrange`` prepares; call ``watch`` with the pen and the remaining seconds."""
        clock = Clock()
        pen = self.lab.Pen(clock, seed)
        arrange(pen)
        pen.start()
        robot = PyroRobot(pen.driver(), clock)
        failed: list[Any] = []
        robot.connect().addErrback(failed.append)
        while robot.timestamp == 0.0 or not clock.seconds() > 1.0:
            clock.advance(STEP_S)
        engine = Engine(robot, clock)
        engine.run(init).addErrback(failed.append)
        end = clock.seconds() + seconds
        while clock.seconds() < end:
            clock.advance(STEP_S)
            watch(pen, end - clock.seconds())
        engine.stop()
        robot.disconnect()
        for _ in range(20):
            clock.advance(STEP_S)
        pen.stop()
        self.assertEqual((failed, clock.getDelayedCalls()), ([], []))
        return pen

    def test_avoid_wanders_and_hits_no_wall(self) -> None:
        """Within a minute the dog walks several metres in each of two worlds, and touches no wall."""
        for seed in (1, 3):
            places: list[tuple[float, float]] = []

            def watch(pen: Any, left: float, places: list[tuple[float, float]] = places) -> None:
                places.append((pen.dog.x, pen.dog.y))

            pen = self.played(self.avoid.INIT, seed, 60.0, watch)
            wide, high = pen.world.scene.width, pen.world.scene.height
            nearest = min(min(x, wide - x, y, high - y) for x, y in places)
            self.assertGreater(nearest, FOOTPRINT_RADIUS_M + 0.005, seed)
            way = sum(math.dist(a, b) for a, b in zip(places, places[1:], strict=False))
            self.assertGreater(way, 3.0, seed)

    def test_track_ball_turns_to_the_ball(self) -> None:
        """From each side the dog turns until the ball is straight ahead, and does so again after the ball has moved."""
        for heading in (2.0, -2.5):
            off: list[float] = []

            def arrange(pen: Any, heading: float = heading) -> None:
                pen.world.clear_target()
                for name, place in (
                    ("dog2", (2.8, 0.2, 0.0)),
                    ("dog3", (2.8, 2.2, 0.0)),
                    ("dog1", (1.0, 1.2, heading)),
                ):
                    pen.world.move_dog(name, *place)
                pen.world.place_target(1.8, 1.2)

            def watch(pen: Any, left: float, off: list[float] = off) -> None:
                dog, ball = pen.dog, pen.world.target
                towards = math.atan2(ball.y - dog.y, ball.x - dog.x)
                off.append(abs(math.degrees(math.remainder(towards - dog.heading, math.tau))))
                if abs(left - 5.0) < STEP_S / 2:
                    pen.world.place_target(1.7, 1.5)

            self.played(self.track_ball.INIT, 1, 18.0, watch, arrange)
            moved_at = round(13.0 / STEP_S)
            self.assertLess(off[moved_at - 10], 5.0, heading)
            self.assertGreater(max(off[moved_at:]), 15.0, heading)
            self.assertLess(off[-1], 5.0, heading)
