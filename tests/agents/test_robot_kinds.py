"""Tests of ``agents.search`` with robots of all kinds, in closed loop with the simulator in virtual time."""

from __future__ import annotations

import math
from dataclasses import replace
from random import Random

from twisted.trial.unittest import SynchronousTestCase

from agents.context import Context
from agents.motion import WALK_SPEED_MPS, MotionCapabilities
from agents.search import SearchAndApproach
from agents.vision import Detection
from drivers.bittle.gait import Velocity
from drivers.reading import Action, Observation, Value
from tests.agents.roamer import Roamer, described, quantised

LAG = {"bittle": 0.3}
ARCS = {"f": Velocity(0.08, 0.0), "b": Velocity(-0.05, 0.0), "l": Velocity(0.06, 0.4), "r": Velocity(0.06, -0.4)}
JERKS = {"f": Velocity(0.15, 0.0), "b": Velocity(-0.1, 0.0), "l": Velocity(0.0, 1.2), "r": Velocity(0.0, -1.2)}


def roamer(kind: str, seed: int) -> Roamer:
    """Return a robot of this kind and a target, both at random positions."""
    return Roamer(kind, seed, lag=LAG.get(kind, 0.1))


def with_gaits(gaits: dict[str, Velocity], seed: int) -> Roamer:
    """Return a robot dog with exactly these gaits."""
    description = described("bittle")
    limits = {
        "base.vx": (min(one.vx for one in gaits.values()), max(one.vx for one in gaits.values())),
        "base.wz": (min(one.wz for one in gaits.values()), max(one.wz for one in gaits.values())),
    }
    description = replace(description, limits=limits)
    return Roamer("bittle", seed, quantised(description, gaits), 0.3, description)


class RobotKindTests(SynchronousTestCase):
    def arrived(self, robot: Roamer, limit: float = 60.0) -> None:
        """Check that the robot stopped close to the target, and that each bump was at most as fast as a slow walk."""
        self.assertTrue(robot.reach(limit), "never done")
        self.assertLessEqual(robot.gap, 0.15)
        self.assertLessEqual(robot.hardest, max(WALK_SPEED_MPS, robot.motion.walk) + 0.01)

    def test_robots_that_feel_their_way_find_it_too(self) -> None:
        """A robot without a ranger reaches the target, and bumps into obstacles at most at the speed of a slow walk."""
        for kind in ("create2", "bittle"):
            with self.subTest(kind=kind):
                robot = roamer(kind, 1)
                robot.world.clear_target()
                while robot.now < 60.0:
                    robot.live(robot.behaviour.search)
                robot.world.place_target_at_random()
                self.assertIsNotNone(robot.find(180.0))
                self.arrived(robot)

    def test_robot_that_turns_in_jerks_does_not_swing_for_ever(self) -> None:
        """A robot that can turn only at 1.2 rad/s aims coarsely, so it reaches the target with few reversals."""
        for seed in (1, 2):
            with self.subTest(seed=seed):
                robot = with_gaits(JERKS, seed)
                self.assertIsNotNone(robot.find(60.0))
                self.arrived(robot)
                self.assertLess(robot.reversals, 10)

    def test_robot_that_turns_only_as_it_walks_gets_there(self) -> None:
        """A robot that cannot turn on the spot searches on arcs, and leaves a target inside its turning circle."""
        for seed in (1, 2):
            with self.subTest(seed=seed):
                robot = with_gaits(ARCS, seed)
                self.assertIsNotNone(robot.find(90.0))
                self.assertAlmostEqual(robot.motion.circle, 0.15)
                self.arrived(robot, 90.0)
        robot = with_gaits(ARCS, 1)
        robot.motion.circle = 0.15
        target = robot.world.target
        assert target is not None
        robot.find(90.0)
        robot.world.place_target(
            robot.dog.x + 0.3 * math.cos(robot.dog.heading + 0.45),
            robot.dog.y + 0.3 * math.sin(robot.dog.heading + 0.45),
        )
        robot.live(robot.behaviour.search)
        self.assertTrue(robot.reach(90.0))


class BumpTests(SynchronousTestCase):
    def facing(self, seed: int = 1) -> Roamer:
        """Return a Create 2 that has found the target."""
        robot = roamer("create2", seed)
        self.assertIsNotNone(robot.find(60.0))
        return robot

    def test_bump_into_the_target_is_an_arrival(self) -> None:
        """If the target is smaller than stated, it appears too far away; then a bump into it completes the task."""
        robot = roamer("create2", 1)
        robot.behaviour = SearchAndApproach({"target_radius": 0.16, "target_height": 0.44}, Random(4))
        robot.behaviour.embody(robot.motion)
        self.assertIsNotNone(robot.find(60.0))
        self.assertTrue(robot.reach(60.0))
        self.assertLess(robot.gap, 0.15)
        self.assertLessEqual(robot.hardest, 0.17)

    def test_bump_on_the_way_is_gone_round(self) -> None:
        """The robot bumps into an invisible obstacle once, backs off, drives around it, and reaches the target."""
        robot = self.facing()
        for _ in range(60):
            robot.live(lambda now: robot.behaviour.execute(Context(now)))
        sense, until = robot.sense, robot.now + 0.3
        robot.sense = lambda: {**sense(), "bump.left": robot.now < until}  # type: ignore[method-assign]
        speeds = []
        for _ in range(100):
            robot.live(lambda now: robot.behaviour.execute(Context(now)))
            speeds.append(robot.done["base.vx"])
        self.assertLess(min(speeds), 0.0)
        first = next(n for n, speed in enumerate(speeds) if speed < 0.0)
        self.assertLess(first, 5)
        self.assertTrue(robot.reach(60.0))
        self.assertLessEqual(robot.gap, 0.15)

    def test_body_that_goes_nowhere_has_bumped(self) -> None:
        """A robot without bumper and ranger backs off if it walks for two seconds and its odometry does not change."""
        robot = roamer("bittle", 1)
        robot.world.clear_target()
        behaviour, motion = robot.behaviour, robot.motion
        now, backed = 0.0, []
        yaw = 0.0
        for _ in range(1200):
            now += 0.05
            values = {"odom.x": 1.0, "odom.y": 1.0, "odom.yaw": math.remainder(yaw, math.tau)}
            behaviour.look(Observation(now, now, values), now)
            action = motion.remove_missing_axes(behaviour.search(now))
            done = robot.does(action)
            motion.learn(action, done)
            yaw += done["base.wz"] * 0.05
            if done["base.vx"] < 0.0:
                backed.append(now)
        self.assertTrue(backed)


class StubRobot:
    """A behaviour that controls a robot of this kind and receives target positions instead of camera frames."""

    def __init__(self, kind: str) -> None:
        self.motion = MotionCapabilities(described(kind))
        self.behaviour = SearchAndApproach({}, Random(1))
        self.behaviour.embody(self.motion)
        self.now = 0.0

    def see(self, distance: float, bearing: float = 0.0, **values: Value) -> None:
        """Process one observation; ``bump_left`` stands for ``bump.left``."""
        self.now += 0.05
        told: dict[str, Value] = {"odom.x": 0.0, "odom.y": 0.0, "odom.yaw": 0.0}
        told |= {key.replace("_", "."): value for key, value in values.items()}
        self.behaviour.look(Observation(self.now, self.now, told), self.now)
        self.behaviour._add_detection(self.now, self.behaviour._pose, Detection(bearing, distance, True))

    def execute(self) -> Action | None:
        """Return the next action."""
        return self.behaviour.execute(Context(self.now))


class NearTests(SynchronousTestCase):
    def acts(self, distance: float, bearing: float) -> list[Action | None]:
        """Return five actions of a Create 2 with its bumper pressed and the target at this distance and bearing."""
        stub, acts = StubRobot("create2"), []
        for _ in range(5):
            stub.see(distance, bearing, bump_left=True)
            acts.append(stub.execute())
        return acts

    def test_bump_counts_as_arrival_before_the_target_only(self) -> None:
        """A bump completes the task only if the target is close and ahead; after any other bump the robot backs off."""
        self.assertIsNone(self.acts(0.33, 0.05)[-1])
        for distance, bearing in ((0.33, 0.6), (1.0, 0.05)):
            acts = self.acts(distance, bearing)
            self.assertTrue(all(action is not None and action["base.vx"] < 0.0 for action in acts), (distance, bearing))

    def test_who_turns_on_a_circle_backs_off_from_what_is_in_it(self) -> None:
        """A robot backs off from a target inside its turning circle, and turns towards a target outside of it."""
        stub = StubRobot("bittle")
        stub.motion.circle = 0.15
        for distance, sign in ((0.2, -1.0), (1.0, 1.0)):
            stub.see(distance, 0.7)
            action = stub.execute()
            assert action is not None
            self.assertGreater(sign * action["base.vx"], 0.0, distance)
            self.assertEqual(action["base.wz"] > 0.0, sign > 0.0)


class WayTests(SynchronousTestCase):
    def test_robot_that_cannot_step_aside_goes_round(self) -> None:
        """A robot with a ranger that cannot step sideways drives around another robot without pushing it."""
        robot = roamer("rosbridge", 1)
        world = robot.world
        world.clear_target()
        world.move_dog("dog3", 2.8, 2.2, 0.0)
        world.move_dog("dog2", 2.8, 0.2, 0.0)
        world.move_dog("dog1", 0.4, 1.2, 0.0)
        world.place_target(2.2, 1.2)
        self.assertIsNotNone(robot.find(60.0))
        for _ in range(30):
            robot.live(lambda now: robot.behaviour.execute(Context(now)))
        world.move_dog("dog2", 1.4, 1.21, math.pi / 2)
        before = world.dogs["dog2"].x, world.dogs["dog2"].y
        self.assertTrue(robot.reach(90.0))
        self.assertLessEqual(robot.gap, 0.15)
        after = world.dogs["dog2"].x, world.dogs["dog2"].y
        self.assertLess(math.dist(before, after), 0.05)
