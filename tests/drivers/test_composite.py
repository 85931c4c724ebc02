"""Tests of ``drivers.composite``: a Create 2 with additional sensors as one device."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReactorTime

from drivers.base import BaseDriver
from drivers.composite import CompositeDriver, combine_descriptions, combine_drivers
from drivers.conformance import Conformance
from drivers.create2.driver import Create2Driver
from drivers.create2.option import parse_options
from drivers.driver import Driver, Filming, Permit
from drivers.errors import LinkLost, Unsupported, UsageError
from drivers.link import LinkClient, MemoryConnector, Reconnector
from drivers.reading import Action, Description, Frame, Observation, Value
from drivers.registry import create_driver, describe
from sim.robots.emulator.camera import MjpegCamera
from sim.robots.emulator.compass import NmeaCompass
from tests.drivers.contract import KeptLog
from tests.drivers.test_camera_driver import jpeg
from tests.drivers.test_create2_driver import Create2Case


class Part(BaseDriver):
    """A sensor with values set by the test, and one skill."""

    def __init__(
        self,
        clock: IReactorTime,
        kind: str = "compass",
        capability: str = "",
        limits: Mapping[str, object] | None = None,
    ) -> None:
        rates = {capability or kind: 5.0}
        capabilities: dict[str, Mapping[str, float | str]] = {capability or kind: {"mine": 1}}
        super().__init__(
            Description(kind, kind, capabilities, limits or {}, 0.01, rates, ("hum",)),  # type: ignore[arg-type]
            kind,
            clock,
        )
        self.opened = self.closed = 0
        self.t = 100.0
        """The time of the part's clock, which has a different origin."""

    def tell(self, frame: Frame | None = None, **values: Value) -> None:
        if not self._is_up:
            self._up()
        self._observed({key.replace("_", "."): value for key, value in values.items()}, self.t, frame=frame)

    def refuse(self) -> None:
        self._refused(Unsupported("there is no such part"))

    def lose(self) -> None:
        self._down()

    def invoke(self, name: str, **arguments: float | str) -> Deferred[Mapping[str, Value]]:
        return succeed({"hummed": True}) if name == "hum" else super().invoke(name, **arguments)

    def _open(self) -> None:
        self.opened += 1

    def _close(self) -> Deferred[None]:
        self.closed += 1
        return succeed(None)

    def _drive(self, motion: Action, permit: Permit) -> Action:
        return motion


class Lens(Part):
    """A camera with an adjustable frame rate."""

    camera_fps = 5.0

    def set_camera_fps(self, fps: float) -> None:
        self.camera_fps = fps


class CompositeDriverTests(Conformance, Create2Case):
    """A Create 2 with a camera passes the conformance tests."""

    END_S = 0.2

    def build(self) -> None:
        """Use a folder of pictures as the camera."""
        super().build()
        self.folder = Path(self.mktemp())
        self.folder.mkdir()
        for mark in (1, 2, 3):
            (self.folder / f"{mark}.jpg").write_bytes(jpeg(mark))

    def make_driver(self, **options: object) -> Driver:
        """Return a Create 2 with a camera, created by the registry."""
        camera = ("camera", {"source": str(self.folder), "fps": 10})
        driver = create_driver("create2", {"port": "memory"}, "vacuum", self.clock, self.connector, [camera])
        self.drivers.append(driver)
        return driver

    def with_parts(self, *parts: Driver) -> CompositeDriver:
        main = Create2Driver(parse_options({"port": "memory"}), "vacuum", self.connector, self.clock)
        driver = combine_drivers(main, parts, "vacuum")
        self.drivers.append(driver)
        return driver

    def test_shows_what_its_parts_see(self) -> None:
        """The device has the camera's capability even before it connects.

        Frames are part of the robot's observations.
        """
        driver = self.make_driver()
        self.assertIn("camera", driver.description.capabilities)
        self.assertEqual(
            (driver.description.kind, driver.description.radius, driver.description.limits["base.vx"]),
            ("create2", 0.174, (-0.5, 0.5)),
        )
        driver = self.ready()
        numbers = []
        driver.subscribe(lambda seen: numbers.append(-1 if seen.frame is None else seen.frame.seq))
        self.pass_time(1.0)
        self.assertEqual(sorted(set(numbers)), list(range(numbers[0], numbers[0] + len(set(numbers)))))
        self.assertIn(len(set(numbers)), (10, 11))
        self.assertGreater(len(numbers), 50)
        self.assertLess(driver.diagnostics()["camera.age"], 0.2)
        self.assertIn("bump.left", self.newest(driver).values)

    def test_rides_with_a_camera_board_and_a_compass(self) -> None:
        """Robot, network camera and compass form one device, but each of them reconnects separately."""
        self.body.jpeg = jpeg(9)
        self.body.values["compass.heading"] = 0.5
        camera, compass = MjpegCamera(self.clock, self.body), NmeaCompass(self.clock, self.body)
        ports = {81: MemoryConnector(self.clock, camera.accept), 10110: MemoryConnector(self.clock, compass.accept)}

        class Network:
            def connect(_self, host: str, port: int, client: LinkClient) -> Reconnector:  # noqa: N805
                line: Reconnector = ports.get(port, self.connector).connect(host, port, client)
                return line

        parts = [("camera", {"url": "http://board:81/stream"}), ("compass", {"host": "board"})]
        driver = create_driver("create2", {"port": "memory"}, "vacuum", self.clock, Network(), parts)
        self.drivers.append(driver)
        self.assertTrue({"camera", "compass", "bumper"} <= set(driver.description.capabilities))
        connected = driver.connect()
        self.pass_time(0.3)
        self.successResultOf(connected)
        self.assertEqual((self.newest(driver).frame, driver.state), (None, "ready"))
        camera.start()
        compass.start()
        self.pass_time(1.0)
        frame = self.newest(driver).frame
        assert frame is not None
        self.assertEqual(frame.data, jpeg(9))
        self.assertAlmostEqual(float(self.newest(driver).values["compass.heading"]), 0.5, 2)
        ports[81].cut()
        self.pass_time(0.1)
        self.assertIsNone(self.newest(driver).frame)
        self.assertIn("compass.heading", self.newest(driver).values)
        self.pass_time(2.0)
        self.assertIsNotNone(self.newest(driver).frame)
        counts = driver.diagnostics()
        self.assertEqual((counts["reconnects"], counts["camera.reconnects"], counts["compass.reconnects"]), (0, 1, 0))
        driver.disconnect()
        camera.stop()
        compass.stop()

    def test_leaves_out_what_is_not_ready(self) -> None:
        """The values of a silent part are omitted until the part's next observation; the device stays ready."""
        compass = Part(self.clock)
        driver = self.with_parts(compass)
        driver.connect()
        self.pass_time(0.2)
        self.assertNotIn("compass.heading", self.newest(driver).values)
        compass.tell(compass_heading=1.5)
        self.pass_time(0.1)
        self.assertEqual(self.newest(driver).values["compass.heading"], 1.5)
        self.pass_time(0.5)
        self.assertNotIn("compass.heading", self.newest(driver).values)
        self.assertEqual(driver.state, "ready")
        self.assertGreater(driver.diagnostics()["compass.age"], 0.4)
        compass.tell(compass_heading=1.0)
        self.pass_time(0.1)
        self.assertEqual(self.newest(driver).values["compass.heading"], 1.0)
        compass.lose()
        self.pass_time(0.1)
        self.assertNotIn("compass.heading", self.newest(driver).values)

    def test_says_why_its_robot_is_not_heard(self) -> None:
        """``problem`` and ``token`` of the composite device are those of its robot."""
        main = Create2Driver(parse_options({"port": "memory"}), "vacuum", self.connector, self.clock)
        driver = combine_drivers(main, [Part(self.clock)], "vacuum")
        self.connector.is_open = False
        driver.connect().addErrback(lambda _: None)
        main._set_problem("the cable is out")
        self.assertEqual((driver.problem, driver.token), ("the cable is out", 0))
        driver.disconnect()

    def test_is_as_fresh_as_its_robot(self) -> None:
        """New values of a part (an additional sensor) cause no observation.

        They do not make the values of a silent robot look new.
        """
        compass = Part(self.clock)
        driver, seen = self.with_parts(compass), list[Observation]()
        driver.subscribe(seen.append)
        connected = driver.connect()
        compass.tell(compass_heading=1.0)
        self.assertEqual((seen, driver.observe(), driver.state), ([], None, "connecting"))
        self.assertNoResult(connected)
        self.pass_time(0.3)
        self.assertEqual(self.successResultOf(connected), driver.description)
        self.connector.is_open = False
        self.connector.cut()
        count, age = len(seen), driver.diagnostics()["age"]
        for _ in range(10):
            self.pass_time(0.1)
            compass.tell(compass_heading=1.0)
        self.assertEqual((len(seen), driver.state), (count, "stale"))
        self.assertGreater(driver.diagnostics()["age"], age + 0.9)

    def test_keeps_what_is_the_robots(self) -> None:
        """If the robot and a part have the same key or capability, the robot's is used.

        Of two parts with the same key or capability, the first part is used.
        """
        robot, part = Part(self.clock), Part(self.clock)
        alone = combine_drivers(robot, [part], "post")
        alone.connect()
        robot.tell(compass_heading=1.0)
        part.tell(compass_heading=9.0, hum_hz=50.0)
        robot.tell(power_level=1.0)  # this observation has no heading
        self.assertEqual(self.newest(alone).values, {"power.level": 1.0, "hum.hz": 50.0})
        first, second, vain = Part(self.clock), Part(self.clock), Part(self.clock, "case", "power")
        driver = self.with_parts(first, second, vain)
        self.assertEqual(driver.description.capabilities["power"], {})
        self.assertEqual(driver.description.capabilities["compass"], {"mine": 1})
        self.assertEqual(driver.description.rates["compass"], 5.0)
        driver.connect()
        self.pass_time(0.2)
        vain.tell(power_level=0.01)
        second.tell(compass_heading=2.0)
        self.pass_time(0.05)
        seen = self.newest(driver).values
        self.assertEqual((seen["power.level"], seen["compass.heading"]), (1.0, 2.0))
        first.tell(compass_heading=1.0)
        self.pass_time(0.05)
        self.assertEqual(self.newest(driver).values["compass.heading"], 1.0)
        self.assertIn("compass.frames", driver.diagnostics())
        self.assertIn("compass2.frames", driver.diagnostics())

    def test_dates_a_picture_by_the_robots_clock(self) -> None:
        """The age of a frame is correct for any offset between the clocks of the part and the robot."""
        lens = Lens(self.clock, "camera")
        driver = self.with_parts(lens)
        driver.connect()
        self.pass_time(0.2)
        lens.tell(Frame(7, 4, 3, b"", lens.t - 0.02))
        self.pass_time(0.1)
        seen = self.newest(driver)
        assert seen.frame is not None
        age = seen.t_robot - seen.frame.t_robot + self.now() - seen.t_host
        self.assertTrue(math.isclose(age, 0.12, abs_tol=1e-6), age)
        self.assertEqual(seen.frame.seq, 7)

    def test_films_where_somebody_does(self) -> None:
        """The frame rate is passed to the part that has a camera; without such a part, setting it fails."""
        lens = Lens(self.clock, "camera")
        driver: object = self.with_parts(Part(self.clock), lens)
        assert isinstance(driver, Filming)
        driver.set_camera_fps(2.0)
        self.assertEqual((lens.camera_fps, driver.camera_fps), (2.0, 2.0))
        self.assertNotIsInstance(self.with_parts(Part(self.clock)), Filming)
        self.assertNotIsInstance(self.with_parts(Part(self.clock, "camera")), Filming)

    def test_asks_who_knows_the_skill(self) -> None:
        """A skill is executed by the robot or by the part that has this skill.

        The error for an unknown skill lists the known skills.
        """
        driver = self.with_parts(Part(self.clock))
        self.assertEqual(driver.description.skills, ("dock", "beep", "hum"))
        self.assertEqual(self.successResultOf(driver.invoke("hum")), {"hummed": True})
        self.failureResultOf(driver.invoke("beep"), LinkLost)
        error = self.failureResultOf(driver.invoke("sing"), Unsupported).value
        self.assertIn("dock, beep, hum", str(error))

    def test_outlives_a_part_that_is_none(self) -> None:
        """If a part fails, this is logged once and the robot still works; a part that never connects is not logged."""
        compass, absent = Part(self.clock), Part(self.clock, "camera")
        driver = self.with_parts(compass, absent)
        driver.log = log = KeptLog()  # type: ignore[assignment]
        connected = driver.connect()
        compass.refuse()
        self.pass_time(0.3)
        self.successResultOf(connected)
        self.assertEqual(driver.state, "ready")
        self.successResultOf(driver.disconnect())
        self.successResultOf(driver.disconnect())
        self.assertEqual(log.lines, ["vacuum: cannot connect to its part compass: there is no such part"])
        self.assertEqual((compass.opened, absent.opened, absent.closed), (1, 1, 1))

    def test_leaves_its_parts_with_its_robot(self) -> None:
        """If the robot fails to connect, the parts are disconnected as well."""
        main, part = Part(self.clock), Part(self.clock)
        driver = combine_drivers(main, [part], "post")
        connected = driver.connect()
        main.refuse()
        self.failureResultOf(connected, Unsupported)
        self.assertEqual((part.opened, part.closed, driver.state), (1, 1, "closed"))

    def test_is_gone_when_all_are(self) -> None:
        """``disconnect`` waits for the parts, even if the robot never connected, and also when called twice."""

        class Slow(Part):
            gone: Deferred[None]

            def _close(self) -> Deferred[None]:
                self.gone = Deferred()
                return self.gone

        part = Slow(self.clock)
        driver = combine_drivers(Part(self.clock), [part], "post")
        connected = driver.connect()
        first, second = driver.disconnect(), driver.disconnect()
        self.failureResultOf(connected, LinkLost)
        for leaving in (first, second):
            self.assertNoResult(leaving)
        part.gone.callback(None)
        for leaving in (first, second):
            self.assertIsNone(self.successResultOf(leaving))

    def test_refuses_a_second_robot(self) -> None:
        """A part that moves is refused because it is a second robot.

        The error for an invalid part contains its number.
        """
        robot = ("bittle", {"port": "/dev/x"})
        compass = describe("camera", {})
        self.assertIn(
            "part 2", str(self.assertRaises(UsageError, combine_descriptions, compass, [compass, describe(*robot)]))
        )
        arguments = "create2", {"port": "memory"}, "vacuum"
        for parts, word in (([robot], "only sense"), ([("warp", {})], "warp"), ([("camera", {"fps": 0})], "fps")):
            for ask in (
                lambda parts=parts: create_driver(*arguments, self.clock, self.connector, parts),
                lambda parts=parts: describe(*arguments, parts),
            ):
                line = str(self.assertRaises(UsageError, ask))
                self.assertTrue(line.startswith("part 1: ") and word in line, line)
