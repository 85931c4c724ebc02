"""Tests of ``agents.search`` with the drivers of real robots, connected to emulators of simulated dogs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from random import Random
from typing import Any

from twisted.internet.task import Clock, LoopingCall
from twisted.trial.unittest import SynchronousTestCase

from agents.context import Context
from agents.motion import MotionCapabilities
from agents.search import SearchAndApproach
from drivers.driver import Driver, Permit
from drivers.link import MemoryConnector
from drivers.reading import Frame, Observation, Value
from drivers.registry import create_driver
from sim.robots.camera import Camera
from sim.robots.emulator.aibo_dog import AiboEmulator
from sim.robots.emulator.bittle import Bittle
from sim.robots.emulator.create2 import Create2
from sim.robots.emulator.rosbridge import RosbridgeRobot
from sim.robots.scene import FOOTPRINT_RADIUS_M, load_scene
from sim.robots.sensor import Sensors
from sim.robots.world import SUBSTEP_S, World
from tests.agents.roamer import filming

STEPS = 2
TICK_S = 0.048
FPS = {"bittle": 5.0}
TOUCH = 0.15
"""The largest distance to the target, in metres, at which the target counts as reached."""


class DogBody:
    """A simulated dog in its own world, moved and sensed by an emulator."""

    def __init__(self, clock: Clock, seed: int) -> None:
        self.world = World(Random(seed), load_scene("three-dogs"))
        self.world.scatter(seed)
        self.world.place_target_at_random()
        self.dog = self.world.dogs["dog1"]
        self._senses = Sensors(Random(seed + 1), self.world, self.dog)
        self._camera = Camera(Random(seed + 2), self.world)
        self._loop = LoopingCall(self._turn)
        self._loop.clock = clock
        self._loop.start(STEPS * SUBSTEP_S)

    def drive(self, vx: float, vy: float, wz: float) -> None:
        """Set the velocity."""
        self.world.drive("dog1", vx, vy, wz)

    def halt(self) -> None:
        """Stop the dog."""
        self.world.halt("dog1")

    def sense(self) -> Mapping[str, Value]:
        """Return the sensor values except the chest ranger, which points at the floor."""
        return {key: value for key, value in self._senses.values().items() if key != "range.chest"}

    def picture(self, is_halved: bool = False) -> bytes | None:
        """Return a camera frame."""
        return self._camera.render_jpeg(self.dog, is_halved)

    def _turn(self) -> None:
        for _ in range(STEPS):
            self.world.step()
            self._senses.sample()


def driven(kind: str, robot: DogBody, clock: Clock) -> Driver:
    """Return a driver of this kind, connected in memory to the emulator of ``robot``."""
    emulator: Any
    if kind == "aibo":
        emulator = AiboEmulator(clock, robot, Random(1))
        emulator.start()
        return create_driver(kind, {"host": "dog"}, "robot", clock, emulator.connector())
    if kind == "rosbridge":
        emulator = RosbridgeRobot(clock, robot, Random(1))
        emulator.start()
        options = {"image_topic": "/camera/image_raw/compressed", "camera_lens": 56.9}
        return create_driver(kind, options, "robot", clock, MemoryConnector(clock, emulator.accept))
    emulator = (Create2 if kind == "create2" else Bittle)(robot, clock, Random(1))
    return create_driver(kind, {"port": "memory"}, "robot", clock, MemoryConnector(clock, emulator.accept))


class DriverTests(SynchronousTestCase):
    def reached(self, kind: str, seed: int) -> tuple[DogBody, float]:
        """Let a robot of this kind search for the target; return its world and the seconds that it needed."""
        clock = Clock()
        robot = DogBody(clock, seed)
        driver = driven(kind, robot, clock)
        fps = FPS.get(kind, 15.0)
        has_camera = "camera" in driver.description.capabilities
        motion = MotionCapabilities(driver.description if has_camera else filming(driver.description, fps))
        behaviour = SearchAndApproach({}, Random(seed))
        behaviour.embody(motion)
        enabled: list[bool] = []
        driver.connect().addCallback(lambda _: driver.enable()).addCallback(enabled.append)
        frame, seen_at, started_at = Frame(0, 208, 160, b"", 0.0), 0.0, math.inf
        for _ in range(round(120.0 / TICK_S)):
            for _ in range(12):
                clock.advance(TICK_S / 12)
            now = clock.seconds()
            if not enabled:
                continue
            started_at = min(started_at, now)
            if now - seen_at >= 1.0 / fps:
                frame, seen_at = Frame(frame.seq + 1, 208, 160, robot.picture() or b"", now), now
            seen = driver.observe()
            assert isinstance(seen, Observation)
            behaviour.look(seen if has_camera else replace(seen, frame=frame), now)
            action = behaviour.search(now) if behaviour.cost is None else behaviour.execute(Context(now))
            if action is None:
                driver.disconnect()
                for _ in range(100):
                    clock.advance(0.01)
                return robot, now - started_at
            action = motion.remove_missing_axes(action)
            motion.learn(action, driver.act(action, Permit(1, now + 0.5)))
        self.fail(f"{kind} never reached the target")

    def test_robots_reach_the_target_over_their_own_wire(self) -> None:
        """Each real kind of robot, connected to its emulator, finds the target and stops there without a collision."""
        for kind in ("aibo", "create2", "bittle", "rosbridge"):
            for seed in (1, 4):
                with self.subTest(kind=kind, seed=seed):
                    robot, took = self.reached(kind, seed)
                    target = robot.world.target
                    assert target is not None
                    away = math.dist((target.x, target.y), (robot.dog.x, robot.dog.y))
                    self.assertLess(away - target.radius - FOOTPRINT_RADIUS_M, TOUCH)
                    self.assertEqual(robot.world.collisions, 0)
                    self.assertLess(took, 60.0)
