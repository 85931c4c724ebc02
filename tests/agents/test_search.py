"""Tests of ``agents.search`` in the simulated yard, without nodes and links: body, pictures and behaviour alone."""

from __future__ import annotations

import math
from random import Random
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from agents.context import Context
from agents.means import STOP_AT
from agents.search import HIDDEN, MEMORY, SearchAndApproach
from drivers.reading import Action, Frame, Observation
from sim.robots.camera import Camera
from sim.robots.scene import FOOTPRINT, loaded
from sim.robots.sensor import NOSE, Sensors
from sim.robots.world import SUBSTEP, World

TICK = 8 * SUBSTEP


class Walk:
    """One dog of the yard and its behaviour; the other dogs stand far away."""

    def __init__(self, seed: int = 1, x: float = 0.4, y: float = 1.2, heading: float = 0.0) -> None:
        self.world = World(Random(seed), loaded("three-dogs"))
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
        """Act as under a lease."""
        return self.behaviour.execute(Context(now))

    def live(self, act: Any = None) -> Action | None:
        """One tick: sense, look, act (``search`` where nothing else is said)."""
        for _ in range(8):
            self.world.step()
            self.senses.sample()
        self.now += TICK
        self.frames += 1
        values = {**self.senses.values(), **self.replaced}
        data = b"" if "camera" in self.turned_off else self.camera.jpeg(self.dog)
        frame = Frame(self.frames, 208, 160, data, self.now)
        self.behaviour.look(Observation(self.now, self.now, values, frame=frame), self.now)
        action: Action | None = (act or self.behaviour.search)(self.now)
        if action is not None:
            self.world.drive("dog1", action["base.vx"], action["base.vy"], action["base.wz"])
        return action

    def find(self, limit: float = 60.0) -> float | None:
        """Search until the behaviour can tell the cost."""
        while self.behaviour.cost is None and self.now < limit:
            self.live()
        return self.behaviour.cost

    def distance(self) -> float:
        """Metres from the lens to the target's axis, in truth."""
        assert self.world.target is not None
        x, y = self.dog.x + NOSE * math.cos(self.dog.heading), self.dog.y + NOSE * math.sin(self.dog.heading)
        return math.hypot(self.world.target.x - x, self.world.target.y - y)

    def gap(self) -> float:
        """Metres between footprint and target."""
        target = self.world.target
        assert target is not None
        return math.hypot(target.x - self.dog.x, target.y - self.dog.y) - target.radius - FOOTPRINT


class SearchTests(SynchronousTestCase):
    def test_target_is_found_wherever_it_is(self) -> None:
        """From any heading the dog finds the target, faces it, and tells its distance to 8 %."""
        for heading in (0.0, 1.5, -2.5, 3.1):
            walk = Walk(heading=heading)
            walk.world.place_target(1.6, 1.5)
            cost = walk.find()
            assert cost is not None
            self.assertLess(abs(cost / walk.distance() - 1), 0.08, heading)


class RangerTests(SynchronousTestCase):
    def told(self, replaced: dict[str, float]) -> float:
        """What is told of a target 0.9 m away with these ranges in place of the real ones, relative to the truth."""
        walk = Walk()
        walk.world.place_target(0.4 + NOSE + 0.9, 1.2)
        walk.replaced = replaced
        cost = walk.find()
        assert cost is not None
        return cost / walk.distance()

    def test_ranger_is_believed_where_the_picture_agrees(self) -> None:
        """A range that fits the picture is what is told, for it is the better measure."""
        self.assertLess(abs(self.told({"range.near": math.nan, "range.far": 0.86}) * 0.9 - 0.94), 0.02)

    def test_ranger_that_reads_something_else_is_not_believed(self) -> None:
        """A dog in between (too near), a wall behind (too far) or no range leaves the distance of the picture."""
        for wrong in (0.2, 0.45, 1.4, math.nan):
            self.assertLess(abs(self.told({"range.near": math.nan, "range.far": wrong}) - 1), 0.08, wrong)


class ApproachTests(SynchronousTestCase):
    def reach(self, walk: Walk, limit: float = 60.0) -> None:
        """Walk up to the target until the behaviour says that it is done."""
        while walk.live(walk.execute) is not None:
            self.assertLess(walk.now, limit, "never done")
        walk.world.halt("dog1")

    def test_dog_stops_before_the_target(self) -> None:
        """The dog stands at the target, faces it and has touched nothing."""
        for seed, (x, y) in enumerate(((1.6, 1.5), (1.2, 0.5), (2.2, 1.2))):
            walk = Walk(seed)
            walk.world.place_target(x, y)
            walk.find()
            self.reach(walk)
            self.assertEqual(walk.world.collisions, 0, (x, y))
            self.assertTrue(0.0 < walk.gap() <= STOP_AT + 0.03, (x, y, walk.gap()))

    def test_moved_target_is_followed(self) -> None:
        """The target is moved while the dog walks: the dog goes where it is now."""
        walk = Walk()
        walk.world.place_target(1.8, 1.2)
        walk.find()
        for _ in range(40):
            walk.live(walk.execute)
        walk.world.place_target(1.3, 1.9)
        self.reach(walk)
        self.assertLessEqual(walk.gap(), STOP_AT + 0.03)

    def test_target_that_is_taken_away_is_never_reached(self) -> None:
        """Where the target was taken away the dog is not done: it forgets, and searches again."""
        walk = Walk()
        walk.world.place_target(1.0, 1.2)
        walk.find()
        walk.world.clear_target()
        while walk.now < 25.0:
            self.assertIsNotNone(walk.live(walk.execute))
        self.assertIsNone(walk.behaviour.cost)


class MemoryTests(SynchronousTestCase):
    def found(self) -> Walk:
        """A dog that has found the target."""
        walk = Walk()
        walk.world.place_target(1.6, 1.4)
        self.assertIsNotNone(walk.find())
        return walk

    def test_target_out_of_sight_is_remembered_for_a_while(self) -> None:
        """A target that is hidden for a moment keeps its report; after the memory's seconds the report is gone."""
        walk = self.found()
        walk.turned_off.add("camera")
        hidden = walk.now
        while walk.now - hidden < MEMORY - 0.3:
            walk.live()
            self.assertIsNotNone(walk.behaviour.cost)
        while walk.now - hidden < MEMORY + 0.3:
            walk.live()
        self.assertIsNone(walk.behaviour.cost)

    def test_old_picture_is_not_a_new_sighting(self) -> None:
        """The same picture shown again and again does not keep the memory fresh."""
        walk = self.found()
        observation = Observation(0.0, 0.0, walk.senses.values(), frame=Frame(walk.frames, 208, 160, b"", 0.0))
        walk.behaviour.look(observation, walk.now + MEMORY + 0.1)
        self.assertIsNone(walk.behaviour.cost)


class HiddenTests(SynchronousTestCase):
    """Another robot stands before the target, as a dead one does that was on its way."""

    def hidden(self, at: float = 0.55) -> Walk:
        """A dog that has found the target, and then another stops that far before it on the straight line."""
        walk = Walk()
        walk.world.place_target(1.9, 1.4)
        self.assertIsNotNone(walk.find())
        heading = math.atan2(1.4 - walk.dog.y, 1.9 - walk.dog.x)
        away = NOSE + at
        walk.world.move_dog("dog2", 0.4 + away * math.cos(heading), 1.2 + away * math.sin(heading), heading)
        return walk

    def test_report_stays_for_a_while(self) -> None:
        """A target hidden by another robot keeps its report for as long as another may need to act, and no longer."""
        walk = self.hidden()
        began = walk.now
        while walk.now - began < HIDDEN - 0.5:
            walk.live(walk.behaviour.hold)
            self.assertIsNotNone(walk.behaviour.cost)
        while walk.now - began < HIDDEN + 0.5:
            walk.live(walk.behaviour.hold)
        self.assertIsNone(walk.behaviour.cost)

    def test_way_leads_round_it(self) -> None:
        """Sent to the target, the dog goes round who hides it, does not push it away, and stands at the target."""
        walk = self.hidden()
        other = walk.world.dogs["dog2"]
        place = other.x, other.y
        while walk.live(walk.execute) is not None:
            self.assertLess(walk.now, 60.0)
        self.assertLess(abs(walk.gap() - STOP_AT + 0.02), 0.05)
        self.assertLess(math.dist((other.x, other.y), place), 0.01)


class ParameterTests(SynchronousTestCase):
    def test_sizes_that_cannot_be_are_refused(self) -> None:
        """A target's size that is not finite, not positive, absurd or no number at all is refused when it is made."""
        for name in ("target_radius", "target_height"):
            for wrong in (0.0, -1.0, math.inf, math.nan, 1e9, "big"):
                self.assertRaises(ValueError, SearchAndApproach, {name: wrong}, Random(1))
