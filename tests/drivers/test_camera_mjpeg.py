"""Tests of ``drivers.camera.mjpeg`` against ``sim.robots.emulator.camera``, connected in memory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import drivers
from drivers.camera.codec import encode_part
from drivers.camera.mjpeg import PICTURE_TIMEOUT_S
from drivers.camera.option import parse_url
from drivers.conformance import Conformance
from drivers.driver import Filming
from drivers.errors import LinkLost, UsageError
from drivers.link import MemoryConnector
from drivers.registry import describe
from sim.robots.emulator.camera import MjpegCamera
from tests.drivers.contract import KeptLog, RobotCase
from tests.drivers.test_camera_driver import jpeg

URL = "http://10.0.0.7:81/stream"


class MjpegStreamTests(Conformance, RobotCase):
    """The driver of a network camera passes the conformance tests for sensors and further tests of its functions."""

    END_S = 1.0
    kind = "camera"
    options = {"url": URL, "fps": 30, "width": 128, "height": 96}

    def build(self) -> None:
        self.body.jpeg = jpeg(1)
        self.camera = self.robot = MjpegCamera(self.clock, self.body, 30.0)
        self.faults = self.camera.faults
        self.camera.start()
        self.connector = MemoryConnector(self.clock, self.camera.accept)

    def test_shows_what_the_camera_sees(self) -> None:
        """In each stream format the newest frame has the camera's size and data, and no frame number is missing."""
        for has_length in (True, False):
            for is_chunked in (True, False):
                self.camera.has_length, self.camera.is_chunked = has_length, is_chunked
                self.faults.split = is_chunked
                driver, numbers = self.make_driver(), list[int]()
                driver.subscribe(lambda seen, numbers=numbers: numbers.append(seen.frame.seq))
                driver.connect()
                self.pass_time(0.5)
                self.body.jpeg = jpeg(2)
                self.pass_time(0.5)
                frame = self.newest(driver).frame
                assert frame is not None
                self.assertEqual((frame.width, frame.height, frame.data), (128, 96, jpeg(2)))
                self.assertEqual(numbers, list(range(1, len(numbers) + 1)))
                self.assertIn(len(numbers), (28, 29, 30))
                driver.disconnect()

    def test_takes_as_many_pictures_as_are_wanted(self) -> None:
        """Frames above the requested rate are dropped.

        At rate zero the driver disconnects; a higher rate connects it again.
        """
        driver = self.ready()
        self.assertIsInstance(driver, Filming)
        driver.set_camera_fps(10)
        before = driver.diagnostics()
        self.pass_time(2.0)
        after = driver.diagnostics()
        self.assertIn(after["pictures"] - before["pictures"], (19, 20, 21))
        self.assertIn(after["dropped"] - before["dropped"], (39, 40, 41))
        driver.set_camera_fps(0)
        self.pass_time(3.0)
        self.assertEqual((driver.state, len(self.camera.clients)), ("ready", 0))
        self.assertEqual(driver.diagnostics()["pictures"], after["pictures"])
        driver.set_camera_fps(30)
        self.pass_time(1.0)
        self.assertGreater(driver.diagnostics()["pictures"], after["pictures"] + 20)
        self.assertEqual((driver.diagnostics()["refused"], len(self.camera.clients)), (0, 1))

    def test_takes_every_picture_of_an_uneven_camera(self) -> None:
        """Frames with jitter at the wanted rate are not dropped."""
        driver = self.make_driver(fps=10)
        driver.connect()
        self.camera.stop()
        self.pass_time(0.1)
        stream = driver._stream
        for moment in (0.0, 0.09, 0.21, 0.29, 0.41, 0.49):
            self.clock.advance(10.0 + moment - self.now() if moment else 10.0 - self.now())
            stream._timer.set(100.0, lambda: None)
            stream._on_picture(jpeg(1))
        self.assertEqual((stream.dropped, driver.diagnostics()["pictures"]), (0, 6))

    def test_comes_back_with_the_camera(self) -> None:
        """A lost link is logged once and retried with growing delays, until the camera is ready again."""
        driver = self.ready()
        driver.log = log = KeptLog()
        self.connector.is_open = False
        self.connector.cut()
        self.pass_time(0.1)
        self.assertEqual((driver.state, driver.problem), ("stale", "it closed the connection"))
        self.failureResultOf(driver.enable(), LinkLost)
        self.pass_time(60.0)
        self.assertLess(driver.diagnostics()["refused"], 12)
        self.assertEqual(
            log.lines,
            [
                "robot: it closed the connection; trying again",
                "robot: nothing answers at 10.0.0.7:81; is it on, and in this network?; trying again",
            ],
        )
        self.connector.is_open = True
        self.pass_time(7.5)
        self.assertEqual((driver.state, driver.diagnostics()["reconnects"], driver.problem), ("ready", 1.0, ""))
        self.connector.cut()
        self.pass_time(1.0)
        self.assertEqual((driver.state, driver.diagnostics()["reconnects"]), ("ready", 2.0))

    def test_comes_back_while_no_pictures_are_wanted(self) -> None:
        """At rate zero a lost camera is connected again for a single frame, which shows that it works."""
        driver = self.ready()
        self.connector.is_open = False
        self.connector.cut()
        self.pass_time(0.1)
        driver.set_camera_fps(0)
        self.pass_time(10.0)
        self.assertEqual(driver.state, "stale")
        self.connector.is_open = True
        self.pass_time(7.5)
        self.assertEqual((driver.state, len(self.camera.clients)), ("ready", 0))

    def test_notices_a_camera_that_fell_silent(self) -> None:
        """A connection without data is closed and opened again until the camera sends frames."""
        driver = self.ready()
        self.faults.half_open = True
        self.pass_time(1.0)
        self.assertEqual(driver.state, "stale")
        self.pass_time(PICTURE_TIMEOUT_S)
        self.assertIn("no pictures come", driver.problem)
        self.faults.half_open = False
        self.pass_time(2.0)
        self.assertEqual(driver.state, "ready")

    def test_names_what_is_no_camera(self) -> None:
        """An invalid response is reported with a remedy, and retried with back-off until frames arrive."""
        self.camera.status = "401 Unauthorized"
        driver = self.make_driver()
        connected = driver.connect()
        self.pass_time(20.0)
        self.assertNoResult(connected)
        self.assertIn("NAME:PASSWORD", driver.problem)
        self.assertIn(driver.diagnostics()["refused"], (5, 6, 7))
        self.camera.status = "200 OK"
        self.camera.kind = "text/html"
        self.pass_time(6.0)
        self.assertIn("text/html", driver.problem)
        self.camera.kind = "multipart/x-mixed-replace; boundary=frame"
        self.body.jpeg = bytes(1024 * 1024 + 1)
        self.pass_time(6.0)
        self.assertIn("more than 1048576 bytes", driver.problem)
        self.body.jpeg = jpeg(4)
        self.pass_time(6.0)
        self.successResultOf(connected)
        self.assertEqual(driver.state, "ready")

    def test_survives_a_foul_network(self) -> None:
        """Lost, invalid, delayed and split data cost frames; after the faults every frame arrives."""
        driver = self.make_driver()
        driver.connect()
        self.faults.drop, self.faults.garbage, self.faults.split, self.faults.delay = 0.1, 0.2, True, 0.03
        self.pass_time(30.0)
        self.assertGreater(driver.diagnostics()["pictures"], 50)
        self.faults.drop = self.faults.garbage = 0.0
        self.pass_time(12.0)
        before = driver.diagnostics()
        self.pass_time(1.0)
        after = driver.diagnostics()
        self.assertGreater(after["pictures"] - before["pictures"], 25)
        self.assertEqual(after["bad_frames"], before["bad_frames"])

    def test_says_that_the_pictures_have_another_size(self) -> None:
        """Frames of a different size than configured are accepted, and the correct settings are logged once."""
        driver = self.make_driver(width=320, height=240)
        driver._stream.log = log = KeptLog()
        driver.connect()
        self.pass_time(1.0)
        self.assertEqual(log.lines, ["10.0.0.7:81: its pictures are 128 x 96: write width = 128, height = 96"])
        self.assertEqual(driver.description.capabilities["camera"]["width"], 320)

    def test_hears_no_more_of_a_call_that_is_over(self) -> None:
        """Late data and the end of a previous connection have no effect on the new connection."""
        driver = self.ready()
        stream = driver._stream
        old = stream._attempt
        driver.set_camera_fps(0)
        driver.set_camera_fps(30)
        count = driver.diagnostics()["pictures"]
        old.data_received(encode_part(jpeg(2)))
        old.link_down()
        self.assertEqual((driver.diagnostics()["pictures"], driver.problem, driver.state), (count, "", "ready"))

    def test_is_told_where_it_is(self) -> None:
        """A URL contains host, port, path and credentials; the error for an invalid URL does not show the URL."""
        place = parse_url("http://anna:s%20p@cam.lan/a/b?c=1")
        self.assertEqual((place.host, place.port, place.path, place.login), ("cam.lan", 80, "/a/b?c=1", "anna:s p"))
        self.assertEqual((place.name, parse_url("http://[::1]:81").name), ("cam.lan:80", "[::1]:81"))
        self.assertEqual(parse_url("http://[::1]:81").path, "/")
        body = describe("camera", {"url": URL, "width": 104, "height": 80, "lens": 50})
        self.assertEqual(body.model, "a camera on the network")
        lens = {"fov_h_deg": 50, "ahead": 0.1}
        self.assertEqual(body.capabilities["camera"], {"width": 104, "height": 80, "fps": 10.0, **lens})
        for url in (
            *(7, "", "cam", "http://", "http://cam:0/", "http://cam:port/", "http://cam:99999/", "ftp://cam/"),
            *("http://anna:secret@/", "http://cam/a b", "http://cam/\n", "http://cäm/", "http://[::1", "https://cam/"),
            "http://cam/" + "x" * 500,
        ):
            line = str(self.assertRaises(UsageError, describe, "camera", {"url": url}))
            self.assertIn("option url", line)
            self.assertNotIn("secret", line)
        both = {"url": URL, "source": 0}
        self.assertIn("exclude", str(self.assertRaises(UsageError, describe, "camera", both)))

    def test_needs_no_opencv(self) -> None:
        """The driver of a network camera loads neither OpenCV, NumPy nor pyserial, and starts no thread."""
        script = (
            "import sys, threading; from twisted.internet.task import Clock\n"
            "from drivers.registry import create_driver; from drivers.link import MemoryConnector\n"
            "clock = Clock()\n"
            f"driver = create_driver('camera', {{'url': {URL!r}}}, 'cam', clock, MemoryConnector(clock, None))\n"
            "driver.connect()\n"
            "assert not {'cv2', 'numpy', 'serial', 'twisted.internet.reactor'} & set(sys.modules)\n"
            "assert threading.active_count() == 1"
        )
        root = Path(drivers.__file__).parents[1]
        done = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False, cwd=root
        )
        self.assertEqual((done.returncode, done.stderr), (0, ""))
