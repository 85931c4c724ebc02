"""Tests of ``agents.search`` with a simulated robot and its camera, without nodes and links."""

from __future__ import annotations

import math
from random import Random
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from agents.context import Context
from agents.motion import STOP_DISTANCE_M
from agents.search import HIDDEN_TARGET_MEMORY_S, TARGET_MEMORY_S, SearchAndApproach
from drivers.reading import Action, Frame, Observation
from sim.robots.camera import Camera
from sim.robots.scene import FOOTPRINT_RADIUS_M, load_scene
from sim.robots.sensor import NOSE_M, Sensors
from sim.robots.world import SUBSTEP_S, World

TICK = 8 * SUBSTEP_S


class Walk:
    """A simulated dog and its behaviour; the other dogs are far away."""

    def __init__(self, seed: int = 1, x: float = 0.4, y: float = 1.2, heading: float = 0.0) -> None:
        self.world = World(Random(seed), load_scene("three-dogs"))
        self.camera = Camera(Random(seed + 1), self.world)
        self.world.move_dog("dog2", 2.85, 0.15, 0.0)
        self.world.move_dog("dog3", 2.85, 2.25, 0.0)
        self.world.move_dog("dog1", x, y, heading)
        self.dog = self.world.dogs["dog1"]
        self.senses = Sensors(Random(seed + 2), self.world, self.dog)
        self.behaviour = SearchAndApproach({}, Random(seed + 3))
        self.now = 0.0
        self.frames = 0
        self.turned_off: set[str] = set()
        self.replaced: dict[str, float] = {}

    def execute(self, now: float) -> Action | None:
        """Execute the task with an empty context."""
        return self.behaviour.execute(Context(now))

    def live(self, act: Any = None) -> Action | None:
        """Run one tick: sense, observe, and act with ``act`` (default: ``search``)."""
        for _ in range(8):
            self.world.step()
            self.senses.sample()
        self.now += TICK
        self.frames += 1
        values = {**self.senses.values(), **self.replaced}
        data = b"" if "camera" in self.turned_off else self.camera.render_jpeg(self.dog)
        frame = Frame(self.frames, 208, 160, data, self.now)
        self.behaviour.look(Observation(self.now, self.now, values, frame=frame), self.now)
        action: Action | None = (act or self.behaviour.search)(self.now)
        if action is not None:
            self.world.drive("dog1", action["base.vx"], action["base.vy"], action["base.wz"])
        return action

    def find(self, limit: float = 60.0) -> float | None:
        """Search until the behaviour has a cost, for at most ``limit`` seconds."""
        while self.behaviour.cost is None and self.now < limit:
            self.live()
        return self.behaviour.cost

    def distance(self) -> float:
        """Return the true distance in metres from the lens to the target's axis."""
        assert self.world.target is not None
        x, y = self.dog.x + NOSE_M * math.cos(self.dog.heading), self.dog.y + NOSE_M * math.sin(self.dog.heading)
        return math.hypot(self.world.target.x - x, self.world.target.y - y)

    def gap(self) -> float:
        """Return the distance in metres between the robot's footprint and the target."""
        target = self.world.target
        assert target is not None
        return math.hypot(target.x - self.dog.x, target.y - self.dog.y) - target.radius - FOOTPRINT_RADIUS_M


class SearchTests(SynchronousTestCase):
    def test_target_is_found_wherever_it_is(self) -> None:
        """From any heading the dog finds the target, and the reported cost is within 8 % of the true distance."""
        for heading in (0.0, 1.5, -2.5, 3.1):
            walk = Walk(heading=heading)
            walk.world.place_target(1.6, 1.5)
            cost = walk.find()
            assert cost is not None
            self.assertLess(abs(cost / walk.distance() - 1), 0.08, heading)


class RangerTests(SynchronousTestCase):
    def measure_cost(self, replaced: dict[str, float]) -> float:
        """Return the ratio of the reported to the true distance of a target at 0.9 m, with these ranger values."""
        walk = Walk()
        walk.world.place_target(0.4 + NOSE_M + 0.9, 1.2)
        walk.replaced = replaced
        cost = walk.find()
        assert cost is not None
        return cost / walk.distance()

    def test_ranger_is_believed_where_the_picture_agrees(self) -> None:
        """If range and camera agree, the cost is the range, which is the more accurate value."""
        self.assertLess(abs(self.measure_cost({"range.near": math.nan, "range.far": 0.86}) * 0.9 - 0.94), 0.02)

    def test_ranger_that_reads_something_else_is_not_believed(self) -> None:
        """If another dog, a wall behind the target or a missing echo falsifies the range, the camera is used."""
        for wrong in (0.2, 0.45, 1.4, math.nan):
            self.assertLess(abs(self.measure_cost({"range.near": math.nan, "range.far": wrong}) - 1), 0.08, wrong)


class ApproachTests(SynchronousTestCase):
    def reach(self, walk: Walk, limit: float = 60.0) -> None:
        """Execute the task until it is done."""
        while walk.live(walk.execute) is not None:
            self.assertLess(walk.now, limit, "never done")
        walk.world.halt("dog1")

    def test_dog_stops_before_the_target(self) -> None:
        """The dog stops close to the target without a contact."""
        for seed, (x, y) in enumerate(((1.6, 1.5), (1.2, 0.5), (2.2, 1.2))):
            walk = Walk(seed)
            walk.world.place_target(x, y)
            walk.find()
            self.reach(walk)
            self.assertEqual(walk.world.collisions, 0, (x, y))
            self.assertTrue(0.0 < walk.gap() <= STOP_DISTANCE_M + 0.03, (x, y, walk.gap()))

    def test_moved_target_is_followed(self) -> None:
        """If the target moves while the dog walks, the dog walks to its new position."""
        walk = Walk()
        walk.world.place_target(1.8, 1.2)
        walk.find()
        for _ in range(40):
            walk.live(walk.execute)
        walk.world.place_target(1.3, 1.9)
        self.reach(walk)
        self.assertLessEqual(walk.gap(), STOP_DISTANCE_M + 0.03)

    def test_target_that_is_taken_away_is_never_reached(self) -> None:
        """If the target is removed, the task does not complete: the cost expires, and the dog searches again."""
        walk = Walk()
        walk.world.place_target(1.0, 1.2)
        walk.find()
        walk.world.clear_target()
        while walk.now < 25.0:
            self.assertIsNotNone(walk.live(walk.execute))
        self.assertIsNone(walk.behaviour.cost)


class MemoryTests(SynchronousTestCase):
    def found(self) -> Walk:
        """Return a dog that has found the target."""
        walk = Walk()
        walk.world.place_target(1.6, 1.4)
        self.assertIsNotNone(walk.find())
        return walk

    def test_target_out_of_sight_is_remembered_for_a_while(self) -> None:
        """A hidden target keeps its cost for ``TARGET_MEMORY_S`` seconds; then the cost is None."""
        walk = self.found()
        walk.turned_off.add("camera")
        hidden = walk.now
        while walk.now - hidden < TARGET_MEMORY_S - 0.3:
            walk.live()
            self.assertIsNotNone(walk.behaviour.cost)
        while walk.now - hidden < TARGET_MEMORY_S + 0.3:
            walk.live()
        self.assertIsNone(walk.behaviour.cost)

    def test_old_picture_is_not_a_new_sighting(self) -> None:
        """A repeated camera frame does not extend the memory of the target."""
        walk = self.found()
        observation = Observation(0.0, 0.0, walk.senses.values(), frame=Frame(walk.frames, 208, 160, b"", 0.0))
        walk.behaviour.look(observation, walk.now + TARGET_MEMORY_S + 0.1)
        self.assertIsNone(walk.behaviour.cost)


class HiddenTests(SynchronousTestCase):
    """Another robot, for example one that failed on its way, hides the target."""

    def hidden(self, at: float = 0.55) -> Walk:
        """Return a dog that has found the target, after another dog ``at`` metres ahead has hidden it."""
        walk = Walk()
        walk.world.place_target(1.9, 1.4)
        self.assertIsNotNone(walk.find())
        heading = math.atan2(1.4 - walk.dog.y, 1.9 - walk.dog.x)
        away = NOSE_M + at
        walk.world.move_dog("dog2", 0.4 + away * math.cos(heading), 1.2 + away * math.sin(heading), heading)
        return walk

    def test_report_stays_for_a_while(self) -> None:
        """A target hidden by another robot keeps its cost for ``HIDDEN_TARGET_MEMORY_S`` seconds.

        Then the cost is None.
        """
        walk = self.hidden()
        started_at = walk.now
        while walk.now - started_at < HIDDEN_TARGET_MEMORY_S - 0.5:
            walk.live(walk.behaviour.hold)
            self.assertIsNotNone(walk.behaviour.cost)
        while walk.now - started_at < HIDDEN_TARGET_MEMORY_S + 0.5:
            walk.live(walk.behaviour.hold)
        self.assertIsNone(walk.behaviour.cost)

    def test_way_leads_round_it(self) -> None:
        """The dog walks around another dog in front of the target without pushing it, and stops at the target."""
        walk = self.hidden()
        other = walk.world.dogs["dog2"]
        place = other.x, other.y
        while walk.live(walk.execute) is not None:
            self.assertLess(walk.now, 60.0)
        self.assertLess(abs(walk.gap() - STOP_DISTANCE_M + 0.02), 0.05)
        self.assertLess(math.dist((other.x, other.y), place), 0.01)


class ParameterTests(SynchronousTestCase):
    def test_sizes_that_cannot_be_are_refused(self) -> None:
        """A target size that is not a finite number in the permitted range is refused when the behaviour is created."""
        for name in ("target_radius", "target_height"):
            for wrong in (0.0, -1.0, math.inf, math.nan, 1e9, "big"):
                self.assertRaises(ValueError, SearchAndApproach, {name: wrong}, Random(1))
