"""Tests of ``drivers.pyro``: the robot interface of Pyro brains (2011), on top of the present drivers and emulators."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from random import Random
from typing import Any

import cv2
import numpy as np
from twisted.trial.unittest import SynchronousTestCase

from drivers.errors import StaleCommand, Unsupported, UsageError
from drivers.link import MemoryConnector
from drivers.pyro.brain import Brain, Engine
from drivers.pyro.camera import Camera
from drivers.pyro.device import Geometry, SensorArray, SensorValue, make_ranger
from drivers.pyro.robot import TTL_S, PyroRobot
from drivers.reading import Frame, Value
from drivers.registry import describe
from sim.robots.emulator.aibo_dog import AiboEmulator
from sim.robots.emulator.create2 import Create2
from tests.drivers.contract import RobotCase


def encoded(image: Any) -> bytes:
    """Encode a JPEG that keeps the colours almost exactly."""
    finest = [cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return bytes(cv2.imencode(".jpg", image, finest)[1].tobytes())


def picture(left: int, colour: tuple[int, int, int] = (190, 32, 42)) -> bytes:
    """Return a grey picture of 104 x 80 pixels with a 16 x 16 patch of this colour (RGB) at column ``left``."""
    image = np.full((80, 104, 3), 128, np.uint8)
    image[32:48, left : left + 16] = colour[::-1]
    return encoded(image)


class _Lab(RobotCase):
    """A dog that is controlled through ``pyro``."""

    STEP_S = 0.004
    kind = "aibo"
    options: Mapping[str, object] = {"host": "dog"}

    def build(self) -> None:
        self.plug()
        self.driver = self.make_driver()
        self.pyro = PyroRobot(self.driver, self.clock)
        connected: list[bool] = []
        self.pyro.connect().addCallback(connected.append)
        self.pass_time(2.0)
        self.assertEqual(connected, [True])

    def plug(self) -> None:
        self.robot = AiboEmulator(self.clock, self.body, Random(1))
        self.robot.start()
        self.connector = self.robot.connector()

    def moved(self) -> tuple[float, ...]:
        """Return the robot's velocity after a short time, rounded."""
        self.pass_time(0.06)
        return tuple(round(speed, 3) for speed in self.body.motion)


class MotionTests(_Lab):
    def test_shares_become_speeds(self) -> None:
        """A relative speed is scaled by the robot's limit, which differs between forward and backward.

        Positive turns and sideways motions are to the left.
        """
        self.pyro.move(0.5, 0.0)
        self.assertEqual(self.moved(), (0.08, 0.0, 0.0))
        self.pyro.move(-0.5, 0.0)
        self.assertEqual(self.moved(), (-0.078, 0.0, 0.0))
        self.pyro.move(0.0, 0.5)
        self.assertEqual(self.moved(), (0.0, 0.0, 1.015))
        self.pyro.motors(-1.0, 1.0)
        self.assertEqual(self.moved(), (0.0, 0.0, 2.03))

    def test_one_axis_leaves_the_others(self) -> None:
        """``translate``, ``rotate`` and ``strafe`` keep the speeds of the other axes."""
        self.pyro.translate(0.25)
        self.pyro.rotate(0.5)
        self.pyro.strafe(-0.25)
        vx, vy, wz = self.moved()
        self.assertTrue(vx > 0.0 and vy < 0.0 and wz > 0.0, (vx, vy, wz))
        self.pyro.stop()
        self.assertEqual(self.moved(), (0.0, 0.0, 0.0))

    def test_too_much_is_all_there_is(self) -> None:
        """A relative speed above 1 is clipped; a value that is not a number is refused."""
        self.pyro.move(7.0, 0.0)
        self.assertEqual(self.moved(), (0.16, 0.0, 0.0))
        for wrong in (math.nan, math.inf, "fast", True):
            self.assertRaises(UsageError, self.pyro.move, wrong, 0.0)

    def test_robot_stops_when_its_brain_falls_silent(self) -> None:
        """The robot stops half a second after the last command; each ``update`` extends this time."""
        self.pyro.move(0.5, 0.0)
        for _ in range(20):
            self.pass_time(0.1)
            self.pyro.update()
        self.assertNotEqual(self.body.motion, (0.0, 0.0, 0.0))
        self.pass_time(TTL_S + 0.1)
        self.assertEqual(self.body.motion, (0.0, 0.0, 0.0))

    def test_robot_of_a_team_is_not_taken(self) -> None:
        """A robot that has accepted a command of a team refuses motions of the brain, but not a stop."""
        self.driver.act({"base.vx": 0.1}, self.permit(7, 2.0))
        self.assertRaises(StaleCommand, self.pyro.move, 0.5, 0.0)
        self.pyro.stop()
        self.assertEqual(self.moved(), (0.0, 0.0, 0.0))

    def test_pressed_switch_is_no_error_of_the_brain(self) -> None:
        """A pressed emergency stop halts the dog without an exception; the dog moves again only after ``connect``."""
        self.pyro.move(0.5, 0.0)
        self.robot.press_back_button()
        self.pass_time(0.2)
        self.pyro.update()
        self.pyro.move(0.5, 0.0)
        self.assertEqual(self.moved(), (0.0, 0.0, 0.0))
        self.robot.press_back_button()
        self.pass_time(0.2)
        self.pyro.update()
        self.pyro.move(0.5, 0.0)
        self.assertEqual(self.moved(), (0.0, 0.0, 0.0))
        self.pyro.connect()
        self.pass_time(0.2)
        self.pyro.update()
        self.pyro.move(0.5, 0.0)
        self.assertEqual(self.moved(), (0.08, 0.0, 0.0))

    def test_place_is_counted_from_where_it_was_localized(self) -> None:
        """``localize`` sets the pose, and the odometry continues from that pose."""
        self.pyro.move(0.0, 0.5)
        self.pass_time(0.3)
        self.pyro.stop()
        self.pass_time(0.2)
        self.pyro.update()
        self.pyro.localize(1.0, 2.0, math.pi / 2)
        self.assertEqual((self.pyro.x, self.pyro.y, round(self.pyro.th, 6)), (1.0, 2.0, 90.0))
        self.pyro.move(1.0, 0.0)
        self.pass_time(0.4)
        self.pyro.update()
        self.assertLess(abs(self.pyro.x - 1.0), 0.02)
        self.assertTrue(2.04 < self.pyro.y < 2.08, self.pyro.y)


class ThreadTests(_Lab):
    def test_every_call_goes_where_the_driver_lives(self) -> None:
        """Motion, update, stop and sound use the driver only through ``call``, in the thread of the driver."""
        calls: list[Callable[[], Any]] = []
        robot = PyroRobot(self.driver, self.clock, calls.append)
        robot.move(0.5, 0.0)
        self.assertEqual(self.moved(), (0.0, 0.0, 0.0))
        calls[0]()
        self.assertEqual(self.moved(), (0.08, 0.0, 0.0))
        robot.update()
        robot.stop()
        robot.playSound("bark")
        robot.disconnect()
        self.assertEqual((len(calls), self.driver.state), (6, "ready"))


class DeviceTests(_Lab):
    def feel(self, **values: Value) -> None:
        """Set values of the robot's sensors; ``range_near`` stands for ``range.near``."""
        self.body.values |= {key.replace("_", ".", 1): value for key, value in values.items()}
        self.pass_time(0.1)
        self.pyro.update()

    def test_range_sensor_has_values_groups_and_units(self) -> None:
        """Range readings are available one by one, by group and by angle.

        Their units are robot diameters, metres, or fractions.
        """
        self.feel(range_near=0.3, range_far=0.36)
        far = self.pyro.range
        self.assertEqual([round(v, 3) for v in far.distance("M")], [0.3, 0.36, 1.5])
        self.assertAlmostEqual(far[0].value, 0.3 / 0.24)
        self.assertAlmostEqual(far[1].distance("SCALED"), 0.36 / 1.5)
        self.assertEqual([one.pos for one in far["front-all"]], [0, 1])
        self.assertEqual((far["left"], len(far["all"]), len(far[0:2]), len(far[0, 2])), ([], 3, 2, 2))
        self.assertEqual([one.pos for one in far.span(10, -10)], [0, 1])
        self.assertEqual([round(v, 3) for v in far[0].hit if v is not None], [0.42, 0.0, 0.0])

    def test_nothing_in_reach_is_as_far_as_it_sees(self) -> None:
        """A reading without an echo is the sensor's maximum range, not NaN."""
        self.feel(range_near=math.nan)
        self.assertEqual(self.pyro.range[0].distance("M"), 1.5)

    def test_devices_and_features_in_the_words_of_brains(self) -> None:
        """Devices and features have their Pyro names; the error for a missing device or feature contains its name."""
        robot = self.pyro
        self.assertEqual(robot.builtinDevices, ["battery", "camera", "ir", "position", "ptz"])
        self.assertEqual(robot.supportedFeatures, ["continuous-movement", "range-sensor", "odometry", "mono-sound"])
        self.assertEqual((robot.hasA("camera"), robot.hasA("sonar"), robot.supports("odometry")), (1, 0, True))
        self.assertEqual(robot.requires(["range-sensor", "ptz"]), 1)
        self.assertIn(
            "gripper, sonar", str(self.assertRaises(ImportError, robot.requires, ["gripper", "ptz", "sonar"]))
        )
        self.assertIn("it has battery, camera", str(self.assertRaises(AttributeError, getattr, robot, "gripper")))
        self.assertIs(robot.startDevice("camera0"), robot.camera[0])

    def test_device_that_is_removed_tells_nothing_new(self) -> None:
        """A removed device keeps its last values; after ``startDevice`` it is updated again."""
        self.feel(power_level=0.5)
        battery = self.pyro.battery[0]
        self.pyro.removeDevice("battery")
        self.assertEqual((self.pyro.hasA("battery"), battery.state), (0, "stopped"))
        self.feel(power_level=0.4)
        self.assertAlmostEqual(battery.level, 0.5, 2)
        self.pyro.startDevice("battery")
        self.pyro.update()
        self.assertAlmostEqual(battery.level, 0.4, 2)

    def test_joints_buttons_and_sensors_by_their_old_names(self) -> None:
        """The old names of joints, buttons and sensors work; the error for a wrong name lists the known names."""
        self.feel(button_chin=1.0, range_near=0.2)
        robot = self.pyro
        self.assertEqual(robot.getButton("chin"), 1.0)
        self.assertAlmostEqual(robot.getSensor("ir near"), 0.2)
        self.assertEqual(robot.getJoint("left front leg knee"), robot.getJoint("LFr:knee"))
        self.assertEqual(len(robot.getJoint("head pan")), 2)
        self.assertIn("chin", str(self.assertRaises(AttributeError, robot.getButton, "nose")))
        self.assertIn("NECK:pan", str(self.assertRaises(AttributeError, robot.getJoint, "left wing")))
        self.assertRaises(Unsupported, robot.setWalk, "trot")
        robot.playSound("bark")

    def test_head_turns_in_shares(self) -> None:
        """Relative pan and tilt move the dog's joints by a share of their range.

        ``pose`` returns the relative values.
        """
        ptz = self.pyro.ptz[0]
        ptz.setPose(0.5, -0.5, 0.0, 0.5)
        self.pass_time(0.3)
        self.pyro.update()
        for told, wished in zip(ptz.pose, (0.5, -0.5, 0.0, 0.5), strict=True):
            self.assertLess(abs(told - wished), 0.03, ptz.pose)
        ptz.center()
        self.pass_time(0.3)
        self.pyro.update()
        self.assertLess(max(abs(one) for one in ptz.pose), 0.03)

    def test_picture_goes_through_the_filters(self) -> None:
        """A red patch is found in its frame; without a frame the image is zero. An invalid picture is counted."""
        camera = self.pyro.camera[0]
        camera.addFilter("match", 190, 32, 42)
        camera.addFilter("blobify", 0, 255, 255, 0, 1, 1, 1)
        for n, (data, blob) in enumerate(
            ((picture(70), (70, 32, 85, 47, 256)), (picture(5, (0, 0, 0)), (0, 0, 0, 0, 0)))
        ):
            camera.process_frame(Frame(900 + n, 104, 80, data, 0.0))
            self.assertEqual(camera.filterResults, [blob[4], [blob]])
        self.assertEqual((camera.width, camera.height, camera.depth, len(camera.data)), (104, 80, 3, 104 * 80 * 3))
        bad = camera.bad_pictures
        camera.process_frame(Frame(950, 104, 80, b"noise", 0.0))
        self.assertEqual(camera.bad_pictures, bad + 1)
        self.assertRaises(AttributeError, camera.addFilter, "fid")
        camera.clearFilters()
        self.assertEqual(camera.filterResults, [])


class FilterTests(SynchronousTestCase):
    def test_function_as_a_filter(self) -> None:
        """A filter may be a function, which may apply further filters and runs once per picture.

        Two matches mark both colours.
        """
        camera = Camera(104, 80)

        def process(one: Camera) -> Any:
            one.apply("match", 190, 32, 42)
            one.apply("match", 0, 0, 250)
            return one.apply("blobify", 0, 255, 255, 0, 1, 1, 2)

        camera.addFilter(process)
        image = np.full((80, 104, 3), 128, np.uint8)
        image[10:20, 10:20] = (42, 32, 190)
        image[40:60, 40:60] = (250, 0, 0)
        frame = Frame(1, 104, 80, encoded(image), 0.0)
        camera.process_frame(frame)
        camera.process_frame(frame)
        self.assertEqual(camera.pictures, 1)
        self.assertEqual(camera.filterResults, [[(40, 40, 59, 59, 400), (10, 10, 19, 19, 100)]])


class Create2Tests(_Lab):
    kind = "create2"
    options = {"port": "memory"}

    def plug(self) -> None:
        self.robot = Create2(self.body, self.clock, Random(1))
        self.connector = MemoryConnector(self.clock, self.robot.accept)

    def test_robot_without_ranger_has_bumpers(self) -> None:
        """The bumpers of a robot without a ranger are ordered from the left.

        The use of the missing range sensor and sideways motion raise an error.
        """
        self.assertEqual(self.pyro.builtinDevices, ["battery", "bumper", "position"])
        self.assertEqual((self.pyro.bumper[0].value, self.pyro.stall), ([0.0, 0.0], 0))
        self.body.values["bump.right"] = True
        self.pass_time(0.1)
        self.pyro.update()
        self.assertEqual((self.pyro.bumper[0].value, self.pyro.stall), ([0.0, 1.0], 1))
        self.assertEqual([one.pos for one in self.pyro.bumper[0]["right"]], [1])
        error = self.assertRaises(AttributeError, getattr, self.pyro, "range")
        self.assertIn("it has battery, bumper, position", str(error))
        self.assertRaises(Unsupported, self.pyro.strafe, 0.5)
        self.pyro.move(0.2, 0.0)
        self.assertEqual(self.moved(), (0.1, 0.0, 0.0))


class ScanTests(SynchronousTestCase):
    def test_scan_counts_from_the_left(self) -> None:
        """The sectors of a scan are ordered clockwise from the left, and have Pyro's groups."""
        names = ("front", "front_left", "left", "back", "right", "front_right")
        values: dict[str, Value] = {f"range.{name}": 0.1 * n for n, name in enumerate(names)}
        scan = make_ranger(describe("rosbridge", {}), values)
        assert isinstance(scan, SensorArray)
        scan.update(values, 0.0)
        self.assertEqual((scan.type, len(scan)), ("laser", 6))
        self.assertEqual(scan.angle(), sorted(scan.angle(), key=lambda angle: -(angle or 0.0)))
        told = {
            name: [round(one.distance("M"), 1) for one in scan[name]] for name in ("front", "left", "right", "back")
        }
        self.assertEqual(told, {"front": [0.0], "left": [0.2], "right": [0.4], "back": [0.3]})
        self.assertEqual(len(scan["front-all"]), 3)
        self.assertEqual(len(scan["back-all"]), 1)
        self.assertRaises(AttributeError, scan.__getitem__, "above")

    def test_units(self) -> None:
        """Each unit is converted from metres; an unknown unit or angle is refused."""
        one = SensorValue(0.5, 2.0, 0, Geometry(0.1, 0.0, 0.0, math.pi / 2, 0.3), 0.125)
        rows = {"ROBOTS": 2.0, "METERS": 0.5, "m": 0.5, "CM": 50.0, "MM": 500.0, "SCALED": 0.25, "RAW": 0.5}
        self.assertEqual({unit: one.distance(unit) for unit in rows}, rows)
        self.assertEqual((one.angle(), one.angle("radians")), (90.0, math.pi / 2))
        self.assertRaises(AttributeError, one.distance, "feet")
        self.assertRaises(AttributeError, one.angle, "turns")


class BrainTests(_Lab):
    def run_for(self, brain: type[Brain], seconds: float) -> tuple[Brain, list[Any]]:
        """Run a brain of this class for ``seconds``."""
        made: list[Brain] = []

        def init(engine: Engine) -> Brain:
            made.append(brain("one", engine))
            return made[0]

        engine = Engine(self.pyro, self.clock)
        ended: list[Any] = []
        engine.run(init).addBoth(ended.append)
        self.pass_time(seconds)
        engine.stop()
        return made[0], ended

    def test_brain_steps_ten_times_a_second(self) -> None:
        """A brain makes ten steps per second, each after an update; at its end the robot stops."""

        class Walk(Brain):
            def step(self) -> None:
                self.move(0.5, 0.0)

        brain, ended = self.run_for(Walk, 1.0)
        self.assertIn(brain.stepCount, (10, 11))
        self.assertEqual((ended, self.moved()), ([None], (0.0, 0.0, 0.0)))

    def test_brain_that_raises_stops_its_robot(self) -> None:
        """An exception in a step ends the brain, calls ``destroy``, stops the robot, and is reported."""
        given: list[int] = []

        class Fall(Brain):
            def step(self) -> None:
                self.move(1.0, 0.0)
                if self.stepCount == 3:
                    raise ValueError("tripped")

            def destroy(self) -> None:
                given.append(1)

        _, ended = self.run_for(Fall, 1.0)
        self.assertEqual((str(ended[0].value), given, self.moved()), ("tripped", [1], (0.0, 0.0, 0.0)))

    def test_brain_pauses_and_quits(self) -> None:
        """A paused brain makes no steps and its robot stands still; ``quit`` ends the brain."""

        class Nap(Brain):
            def step(self) -> None:
                self.translate(0.5)
                if self.stepCount == 2:
                    self.pleaseStop()

        brain, ended = self.run_for(Nap, 1.0)
        self.assertEqual((brain.stepCount, self.body.motion), (3, (0.0, 0.0, 0.0)))

        class Quit(Brain):
            def step(self) -> None:
                self.quit()

        _, ended = self.run_for(Quit, 0.5)
        self.assertEqual(ended, [None])
