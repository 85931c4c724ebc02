"""Tests of the camera's real thread with a blocking source, and of a real video through OpenCV."""

from __future__ import annotations

import threading
from importlib.util import find_spec
from typing import Any

from twisted.internet import reactor as running
from twisted.internet.task import Clock
from twisted.trial.unittest import TestCase

from drivers.camera.driver import CameraDriver, make_picture_stream
from drivers.camera.option import parse_options
from drivers.camera.picture_stream import ThreadedStream
from drivers.camera.source import JpegPicture
from drivers.errors import LinkLost
from tests.live.waiting import until, wait

reactor: Any = running


class SlowLens:
    """A source that fails once, and blocks when ``gate`` is closed."""

    def __init__(self) -> None:
        self.gate = threading.Event()
        self.threads: set[str] = set()
        self.taken = self.opened = self.closed = 0

    def open(self) -> None:
        self.opened += 1

    def read_picture(self) -> JpegPicture:
        self.threads.add(threading.current_thread().name)
        self.taken += 1
        if self.taken == 5:
            raise LinkLost("it was unplugged")
        self.gate.wait(5.0)
        return JpegPicture(b"\xff\xd8%d\xff\xd9" % self.taken, 4, 3)

    def close(self) -> None:
        self.closed += 1


class LiveCameraTests(TestCase):
    """A real thread in real time."""

    timeout = 30

    async def test_camera_never_holds_the_reactor_up(self) -> None:
        """A blocking camera blocks only its own thread.

        A lost camera is opened again; ``disconnect`` ends the thread.
        """
        lens = SlowLens()
        film = ThreadedStream(lens, reactor.callFromThread)
        driver = CameraDriver(parse_options({"fps": 30}), film, reactor, "cam")
        connected = driver.connect()
        await wait(0.1)
        self.assertNoResult(connected)
        lens.gate.set()
        await connected
        await until(lambda: driver.diagnostics()["reconnects"] == 1)
        self.assertEqual((lens.threads, lens.opened), ({"camera"}, 2))
        driver.set_camera_fps(0)
        await wait(0.1)
        before = lens.taken
        await wait(0.2)
        self.assertEqual((lens.taken, driver.state), (before, "ready"))
        await driver.disconnect()
        self.assertNotIn("camera", [thread.name for thread in threading.enumerate()])
        self.assertEqual(lens.closed, 2)

    def test_shows_a_video_by_the_clock(self) -> None:
        """The frames of a video are complete, have the requested size, and repeat after the end of the video."""
        import cv2
        import numpy

        path = f"{self.mktemp()}.avi"
        video = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
        for shade in (0, 128, 255):
            video.write(numpy.full((48, 64, 3), shade, numpy.uint8))
        video.release()
        clock, shades = Clock(), list[int]()
        wanted = parse_options({"source": path, "fps": 10, "width": 32, "height": 24})
        driver = CameraDriver(wanted, make_picture_stream(wanted, clock), clock, "cam")
        sizes = set()

        def look(seen: Any) -> None:
            picture: Any = cv2.imdecode(numpy.frombuffer(seen.frame.data, numpy.uint8), cv2.IMREAD_GRAYSCALE)
            shades.append(round(float(picture.mean()) / 128))
            sizes.add((seen.frame.width, seen.frame.height, *picture.shape))

        driver.subscribe(look)
        driver.connect()
        clock.pump([0.05] * 13)
        driver.disconnect()
        self.assertEqual((shades[:6], sizes), ([0, 1, 2, 0, 1, 2], {(32, 24, 24, 32)}))

    if find_spec("cv2") is None:
        test_shows_a_video_by_the_clock.skip = "VIDEOS ARE NOT TESTED: install the extra vision"  # type: ignore[attr-defined]
