"""Tests of ``drivers.camera``: pictures from a folder in virtual time, a fake of OpenCV, and faults."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from drivers.camera.driver import make_picture_stream
from drivers.camera.option import Options
from drivers.camera.picture_stream import SourceReader, ThreadedStream, TimedStream
from drivers.camera.source import CaptureSource, FolderSource, JpegPicture, PictureSource
from drivers.conformance import Conformance
from drivers.errors import BadFrame, LinkLost, NotEnabled, Unsupported
from tests.drivers.contract import RobotCase

HEAD = b"\xff\xd8\xff\xe0\x00\x04ab\xff\xc0\x00\x0b\x08\x00\x60\x00\x80\x01\x11\x00\x00"


def jpeg(mark: int) -> bytes:
    """Return the head of a JPEG of 128 x 96 pixels."""
    return HEAD + bytes([mark]) + b"\xff\xd9"


class CameraDriverTests(Conformance, RobotCase):
    """The camera driver passes the conformance tests for sensors and further tests of its functions."""

    STEP_S = 0.01
    kind = "camera"

    def build(self) -> None:
        self.folder = Path(self.mktemp())
        self.folder.mkdir()
        for mark in (1, 2, 3):
            (self.folder / f"{mark}.jpg").write_bytes(jpeg(mark))
        (self.folder / "notes.txt").write_text("no picture", encoding="utf-8")
        self.options = {"source": str(self.folder), "fps": 20}

    def test_shows_a_folder_by_the_clock(self) -> None:
        """The pictures repeat in the order of their file names at the given rate, and are the same in each run."""
        runs = []
        for _ in range(2):
            driver, seen = self.make_driver(fps=10), list[int]()
            driver.subscribe(lambda one, seen=seen: seen.append(one.frame.data[-3]))
            driver.connect()
            self.pass_time(1.0)
            driver.disconnect()
            runs.append(seen)
        self.assertEqual(runs[0], runs[1])
        self.assertEqual(runs[0], [1, 2, 3, 1, 2, 3, 1, 2, 3, 1])
        frame = self.newest(driver).frame
        assert frame is not None
        self.assertEqual((frame.width, frame.height, frame.seq), (128, 96, 10))

    def test_takes_as_many_pictures_as_are_wanted(self) -> None:
        """A new frame rate applies immediately; at rate zero no picture is taken, but the device stays ready."""
        driver = self.ready()
        driver.set_camera_fps(0)
        before = driver.diagnostics()["pictures"]
        self.pass_time(3.0)
        self.assertEqual((driver.state, driver.diagnostics()["pictures"]), ("ready", before))
        driver.set_camera_fps(5)
        self.pass_time(2.0)
        self.assertEqual(driver.camera_fps, 5)
        self.assertIn(driver.diagnostics()["pictures"] - before, (9, 10))
        resting = self.make_driver()
        resting.set_camera_fps(0)
        connected = resting.connect()
        self.pass_time(2.0)
        self.successResultOf(connected)
        self.assertEqual(resting.state, "ready")

    def test_drops_what_is_no_picture(self) -> None:
        """An invalid file is counted and skipped; the other files are sent."""
        (self.folder / "2.jpg").write_bytes(jpeg(2)[:-1])
        driver = self.make_driver()
        driver.connect()
        self.pass_time(1.0)
        counts = driver.diagnostics()
        self.assertGreater(counts["bad_frames"], 5)
        self.assertGreater(counts["pictures"], 2 * counts["bad_frames"] - 2)
        self.assertEqual(driver.state, "ready")

    def test_comes_back_with_its_pictures(self) -> None:
        """Without pictures the driver is stale and retries with growing delays.

        When pictures return, it is ready again.
        """
        driver = self.ready()
        for mark in (1, 2, 3):
            (self.folder / f"{mark}.jpg").unlink()
        self.pass_time(0.2)
        self.assertEqual(driver.state, "stale")
        self.failureResultOf(driver.enable(), LinkLost)
        self.assertRaises(NotEnabled, driver.act, {}, self.permit())
        self.pass_time(30.0)
        self.assertLess(driver.diagnostics()["refused"], 12)
        (self.folder / "4.jpeg").write_bytes(jpeg(4))
        self.pass_time(5.2)
        self.assertEqual((driver.state, driver.diagnostics()["reconnects"]), ("ready", 1.0))
        self.assertEqual(driver.act({}, self.permit()), {})
        self.assertRaises(Unsupported, driver.act, {"base.vx": 0.1}, self.permit())

    def test_waits_for_a_camera_that_is_not_there(self) -> None:
        """If the video is missing, ``connect`` raises no exception; it waits until ``disconnect`` makes it fail."""
        driver = self.make_driver(source=str(self.folder / "none.avi"))
        connected = driver.connect()
        self.pass_time(10.0)
        self.assertNoResult(connected)
        self.assertGreater(driver.diagnostics()["refused"], 2)
        driver.disconnect()
        self.failureResultOf(connected, LinkLost)

    def test_asks_a_device_in_a_thread(self) -> None:
        """A camera, selected by number or device file, is read in a thread; a file is read by a timer."""

        class Reactor(Clock):
            def callFromThread(self, call: Any) -> None:  # noqa: N802 (Twisted's)
                call()

        for source in (0, "/dev/video1"):
            self.assertIsInstance(make_picture_stream(Options(source), Reactor()), ThreadedStream)
        self.assertIsInstance(make_picture_stream(Options("a.avi"), self.clock), TimedStream)


class Picture:
    """A fake of OpenCV's image."""

    def __init__(self, width: int, height: int) -> None:
        self.shape = (height, width, 3)

    def tobytes(self) -> bytes:
        return jpeg(self.shape[1] % 256)


class Lens:
    """A fake of the module cv2 with one camera."""

    CAP_PROP_FRAME_WIDTH, CAP_PROP_FRAME_HEIGHT, CAP_PROP_BUFFERSIZE, CAP_PROP_POS_FRAMES = range(4)
    INTER_AREA = IMWRITE_JPEG_QUALITY = 0

    def __init__(self, *pictures: Picture | None, is_open: bool = True) -> None:
        self.pictures = list(pictures)
        self.set_to: dict[int, float] = {}
        self.is_open = is_open
        self.can_encode = True
        self.released = 0

    def VideoCapture(self, _source: object) -> Lens:  # noqa: N802 (OpenCV's)
        return self

    def isOpened(self) -> bool:  # noqa: N802 (OpenCV's)
        return self.is_open

    def set(self, what: int, value: float) -> None:
        self.set_to[what] = value

    def release(self) -> None:
        self.released += 1

    def read(self) -> tuple[bool, Picture | None]:
        picture = self.pictures.pop(0) if self.pictures else None
        return picture is not None, picture

    def resize(self, _picture: Picture, size: tuple[int, int], interpolation: int) -> Picture:
        return Picture(*size)

    def imencode(self, _kind: str, picture: Picture, _how: object) -> tuple[bool, Picture]:
        return self.can_encode, picture


class PictureSourceTests(SynchronousTestCase):
    def capture(self, lens: Lens, **options: Any) -> CaptureSource:
        with tempfile.NamedTemporaryFile(suffix=".avi", delete=False) as file:
            self.addCleanup(Path(file.name).unlink)
        return CaptureSource(Options(file.name, **options), lambda: lens)

    def test_reduces_large_pictures(self) -> None:
        """A picture larger than requested is reduced and keeps its aspect ratio; a smaller picture is unchanged."""
        source = self.capture(Lens(Picture(1280, 720), Picture(100, 50)), width=320, height=240)
        source.open()
        first, second = source.read_picture(), source.read_picture()
        self.assertEqual((first.width, first.height), (320, 180))
        self.assertEqual((second.width, second.height), (100, 50))

    def test_begins_a_video_anew(self) -> None:
        """A video repeats after its end. A video without frames raises LinkLost, and its capture is released once."""
        lens = Lens(Picture(10, 10), None, Picture(20, 20))
        source = self.capture(lens)
        source.open()
        self.assertEqual([source.read_picture().width, source.read_picture().width], [10, 20])
        self.assertEqual(lens.set_to[Lens.CAP_PROP_POS_FRAMES], 0)
        self.assertRaises(LinkLost, source.read_picture)
        source.close()
        source.close()
        self.assertEqual(lens.released, 1)
        self.assertRaises(LinkLost, source.read_picture)

    def test_names_why_there_are_no_pictures(self) -> None:
        """The error states the cause: no OpenCV, no such camera or file, a busy camera, or an invalid picture."""

        def missing() -> Any:
            raise ImportError("cv2")

        self.assertIn('"vision"', str(self.assertRaises(LinkLost, CaptureSource(Options(0), missing).open)))
        none = CaptureSource(Options("/dev/video62"), lambda: Lens())
        self.assertIn("plugged", str(self.assertRaises(LinkLost, none.open)))
        self.assertIn("no such", str(self.assertRaises(LinkLost, CaptureSource(Options("x"), lambda: Lens()).open)))
        busy = self.capture(Lens(is_open=False))
        self.assertIn("program may be using", str(self.assertRaises(LinkLost, busy.open)))
        lens = Lens(Picture(10, 10))
        lens.can_encode = False
        source = self.capture(lens)
        source.open()
        self.assertRaises(BadFrame, source.read_picture)
        self.assertRaises(LinkLost, FolderSource("/nowhere").open)
        self.assertRaises(LinkLost, FolderSource("/nowhere").read_picture)

    def test_reel_outlives_what_opencv_throws(self) -> None:
        """An exception of OpenCV closes the camera, and the name of the exception is reported.

        The next attempt opens the camera again.
        """

        class Moody(PictureSource):
            rounds = 0

            def open(self) -> None:
                self.rounds += 1

            def read_picture(self) -> JpegPicture:
                if self.rounds == 1:
                    raise RuntimeError("cv2.error: (-215)")
                return JpegPicture(b"", 1, 1)

            def close(self) -> None:
                pass

        told: list[tuple[str, Any]] = []
        reader = SourceReader(Moody(), lambda what, said: told.append((what, said)))
        self.assertGreater(reader.read_picture(), 0.0)
        self.assertEqual(reader.read_picture(), 0.0)
        self.assertEqual(told[0], ("on_source_lost", "RuntimeError: cv2.error: (-215)"))
        self.assertEqual(told[1], ("on_picture", JpegPicture(b"", 1, 1)))
