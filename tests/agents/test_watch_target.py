"""Tests of ``agents.watch_target``: a phone that reports target positions, and a dog that detects the target itself."""

from __future__ import annotations

import math
import random
import subprocess
import sys
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

import agents
from agents.context import Context
from agents.motion import MotionCapabilities
from agents.watch_target import DETECTION_TTL_S, MIN_DETECTIONS, TARGET_MEMORY_S, WatchTarget
from drivers.reading import Action, Description, Frame, Observation, Value
from tests.agents.test_search import Walk

TICK = 0.1


class Phone:
    """A phone and its behaviour; the test moves it."""

    def __init__(self, **parameters: float) -> None:
        self.behaviour = WatchTarget(parameters, random.Random(1))
        self.now = 0.0

    def live(self, distance: float = math.nan, ticks: int = 1) -> None:
        """Process ``ticks`` observations with the target ``distance`` metres ahead (NaN: out of view)."""
        for _ in range(ticks):
            self.now += TICK
            bearing = 0.0 if math.isfinite(distance) else math.nan
            values: dict[str, Value] = {"target.bearing": bearing, "target.distance": distance}
            self.behaviour.look(Observation(self.now, self.now, values), self.now)

    def execute(self, distance: float, ticks: int, token: int = 1, is_resumed: bool = True) -> bool:
        """Observe and execute ``ticks`` times; return whether the task is done."""
        action = None
        for n in range(ticks):
            self.live(distance)
            action = self.behaviour.execute(Context(self.now, token, is_resumed=is_resumed or n > 0))
        return action is None


class PhoneTests(SynchronousTestCase):
    def test_cost_is_the_distance_that_the_phone_tells(self) -> None:
        """The cost is the median of the newest distances, and None until there is a distance."""
        phone = Phone()
        phone.live()
        self.assertIsNone(phone.behaviour.cost)
        phone.live(0.5, MIN_DETECTIONS - 1)
        self.assertIsNone(phone.behaviour.cost)
        phone.live(9.0)
        self.assertEqual(phone.behaviour.cost, 0.5)

    def test_cost_goes_with_the_target(self) -> None:
        """The cost survives a short loss of sight.

        After a longer loss it is None until there are enough new detections.
        """
        phone = Phone()
        phone.live(0.5, MIN_DETECTIONS)
        phone.live(ticks=round(TARGET_MEMORY_S / TICK) - 1)
        self.assertEqual(phone.behaviour.cost, 0.5)
        phone.live(ticks=2)
        self.assertIsNone(phone.behaviour.cost)
        phone.live(2.0, MIN_DETECTIONS - 1)
        self.assertIsNone(phone.behaviour.cost)
        phone.live(2.0)
        self.assertEqual(phone.behaviour.cost, 2.0)

    def test_done_when_it_was_in_view_for_long_enough(self) -> None:
        """The task is done after its time in view; time out of view does not count."""
        phone = Phone(seconds=2.0)
        self.assertFalse(phone.execute(0.5, 11, is_resumed=False))
        self.assertAlmostEqual(phone.behaviour.progress, 0.5)
        phone.execute(math.nan, 30)
        progress = phone.behaviour.progress
        self.assertLessEqual(progress, 0.5 + (DETECTION_TTL_S + TICK) / 2.0)
        phone.execute(math.nan, 30)
        self.assertEqual(phone.behaviour.progress, progress)
        self.assertTrue(phone.execute(0.5, 12))
        self.assertEqual(phone.behaviour.progress, 1.0)

    def test_what_others_did_in_between_does_not_count(self) -> None:
        """Under a new token the progress continues; long gaps and the time between the tokens do not count."""
        phone = Phone(seconds=10.0)
        phone.execute(0.5, 11, is_resumed=False)
        phone.now += 5.0
        phone.execute(0.5, 1, token=2, is_resumed=False)
        self.assertAlmostEqual(phone.behaviour.progress, 0.1)
        phone.now += 5.0
        phone.execute(0.5, 1, token=2)
        self.assertLess(phone.behaviour.progress, 0.13)

    def test_asks_a_phone_for_no_motion(self) -> None:
        """In search, hold and execution, a device without motors gets an empty action."""
        phone = Phone()
        self.assertEqual(phone.behaviour.search(0.0), {})
        phone.live(0.5, MIN_DETECTIONS)
        actions = phone.behaviour.search(phone.now), phone.behaviour.hold(phone.now)
        self.assertEqual((*actions, phone.behaviour.execute(Context(phone.now))), ({}, {}, {}))

    def test_refuses_wrong_parameters(self) -> None:
        """An invalid duration is refused when the task is created."""
        for wrong in (0.0, -1.0, math.inf, math.nan, "long"):
            self.assertRaises(ValueError, WatchTarget, {"seconds": wrong}, random.Random(1))

    def test_a_phones_node_loads_no_vision(self) -> None:
        """For a phone that detects the target itself, the gateway loads neither OpenCV nor NumPy (34 MiB)."""
        script = (
            "import sys, random\nfrom agents.watch_target import WatchTarget\nfrom drivers.reading import Observation\n"
            "watch = WatchTarget({}, random.Random(1))\n"
            "watch.look(Observation(0.0, 0.0, {'target.bearing': 0.0, 'target.distance': 1.0}), 0.0)\n"
            "assert not {'cv2', 'numpy'} & set(sys.modules)"
        )
        root = Path(agents.__file__).parents[1]
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, cwd=root)
        self.assertEqual((done.returncode, done.stderr), (0, ""))


class DogTests(SynchronousTestCase):
    def test_turns_to_the_target_and_keeps_it_in_view(self) -> None:
        """A dog with the target behind it turns to the target, measures its distance, and watches from there."""
        walk = Walk()
        watch = WatchTarget({"seconds": 3.0, "target_radius": 0.08}, random.Random(1))
        walk.behaviour = watch  # type: ignore[assignment]
        walk.world.place_target(1.6, 1.2)
        walk.world.move_dog("dog1", 0.6, 1.2, math.pi)
        walk.find()
        cost = watch.cost
        assert cost is not None
        self.assertLess(abs(cost - walk.distance()), 0.15)
        before = walk.distance()
        contexts = [Context(0.0, is_resumed=False)]

        def execute(now: float) -> Action | None:
            contexts.append(Context(now, is_resumed=len(contexts) > 1))
            return watch.execute(contexts[-1])

        while walk.live(execute) is not None:
            self.assertLess(len(contexts), 60)
        self.assertLess(abs(walk.distance() - before), 0.05)
        self.assertGreater(walk.now, 3.0)

    def test_looks_through_the_lens_of_its_body(self) -> None:
        """The lens in the robot's description is used, even if it arrives later than the first frame."""
        watch = WatchTarget({}, random.Random(1))
        lens = {"camera": {"fov_h_deg": 28.4}}
        watch.embody(MotionCapabilities(Description("narrow", "", lens, {}, 0.1)))
        walk = Walk()
        walk.world.place_target(1.4, 1.2)
        for n in range(4):
            picture = Frame(n, 208, 160, walk.camera.render_jpeg(walk.dog), n * TICK)
            watch.look(Observation(n * TICK, n * TICK, {"odom.yaw": 0.0}, frame=picture), n * TICK)
        cost = watch.cost
        assert cost is not None
        self.assertTrue(1.8 < cost / walk.distance() < 2.5)

    def test_watches_with_a_camera_alone(self) -> None:
        """A fixed camera without motors watches the target: the behaviour detects the target in the frames.

        All actions are empty.
        """
        walk = Walk()
        watch = WatchTarget({}, random.Random(1))
        walk.world.place_target(1.2, 1.2)
        for n in range(10):
            frame = Frame(n, 208, 160, walk.camera.render_jpeg(walk.dog), n * TICK)
            self.assertEqual(watch.search(n * TICK), {})
            watch.look(Observation(n * TICK, n * TICK, {}, frame=frame), n * TICK)
        cost = watch.cost
        assert cost is not None
        self.assertLess(abs(cost - walk.distance()), 0.1)
        self.assertEqual(watch.search(1.0), {})
