"""Attack S20: make a node spend seconds and gigabytes on a picture of a few hundred bytes."""

from __future__ import annotations

import base64
import random
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from twisted.internet import reactor
from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorThreads
from twisted.internet.task import Clock
from twisted.python.failure import Failure
from twisted.trial.unittest import SynchronousTestCase, TestCase
from zope.interface import directlyProvides

from agents.behaviour import create_behaviour
from agents.detection import Detector, run_in_thread
from agents.robot import AgentRobot
from agents.vision import MAX_DETECTION_SIDE_PX, TargetSize, find_target
from drivers.aibo import picture
from drivers.aibo.picture import Block, PictureReader
from drivers.camera.source import FolderSource
from drivers.errors import BadFrame, LinkLost
from drivers.link import MemoryConnector
from drivers.pyro.camera import Camera as PyroCamera
from drivers.reading import Frame, Observation
from drivers.registry import create_driver, describe
from drivers.rosbridge import codec
from formats.jpeg import MAX_DECODED_PX, MAX_SIDE_PX, read_size
from middleware.tasks.task import Task
from sim.robots.emulator.camera import MjpegCamera
from sim.robots.emulator.simulated_robot import MemoryRobot
from swarmnode.gateway import check_picture
from tests.webnode.memory import MemoryFrames
from webnode.camera import CameraStream as WebCamera
from webnode.errors import Refusal

SIZE = TargetSize(0.05, 0.2)
START_OF_SCAN, END = b"\xff\xda", b"\xff\xd9"


def encoded(width: int, height: int, *options: int) -> bytes:
    """Return a picture with a red target, compressed by a real encoder."""
    pixels = np.full((height, width, 3), 128, np.uint8)
    pixels[height // 4 : 3 * height // 4, 2 * width // 5 : 3 * width // 5] = (0, 0, 255)
    return bytes(cv2.imencode(".jpg", pixels, list(options))[1].tobytes())


def claiming(width: int, height: int, kind: bytes = b"\xff\xc0") -> bytes:
    """Return a small picture with a header that states a different size, and optionally a different coding."""
    data = bytearray(encoded(8, 8))
    start = data.index(b"\xff\xc0")
    data[start : start + 2] = kind
    data[start + 5 : start + 9] = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    return bytes(data)


def of_scans(width: int, height: int, count: int) -> bytes:
    """Return a progressive picture in which the last scan is repeated."""
    data = encoded(width, height, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    last = data[data.rindex(START_OF_SCAN) : -len(END)]
    return data[: -len(END)] + (count - data.count(START_OF_SCAN)) * last + END


BOMBS = {
    "629 bytes of 4 gigapixels": claiming(65500, 65500),
    "one side too long": claiming(MAX_SIDE_PX + 1, 8),
    "the other side too long": claiming(8, MAX_SIDE_PX + 1),
    "the height comes later": claiming(4000, 0),
    "3000 scans": of_scans(1000, 1000, 3000),
    "arithmetic coding": claiming(4000, 4000, b"\xff\xc9"),
    "lossless": claiming(4000, 4000, b"\xff\xc3"),
    "a PNG": bytes(cv2.imencode(".png", np.zeros((9000, 9000), np.uint8))[1].tobytes()),
    "a PNG with the ends of a JPEG": b"\xff\xd8"
    + bytes(cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes())
    + END,
    "a BMP": b"BM" + bytes(24) + (2**30).to_bytes(4, "little") * 2 + bytes(600),
}


class BombCase(SynchronousTestCase):
    """A test case that counts the calls of the decoder and the sizes of the decoded pictures."""

    def setUp(self) -> None:
        self.decoded: list[tuple[int, ...]] = []
        decode = cv2.imdecode

        def counted(data: Any, flags: int) -> Any:
            pixels = decode(data, flags)
            assert pixels is not None
            self.decoded.append(pixels.shape[:2])
            return pixels

        self.patch(cv2, "imdecode", counted)


class HeaderTests(BombCase):
    def test_no_bomb_is_decoded(self) -> None:
        """Neither target detection nor student programs decode the bombs, files of at most half a megabyte each."""
        pyro = PyroCamera(8, 8)
        pyro.addFilter(lambda camera: len(camera.data))
        for number, (name, bomb) in enumerate(BOMBS.items(), start=1):
            self.assertLess(len(bomb), 2**19, name)
            self.assertIsNone(read_size(bomb), name)
            self.assertIsNone(find_target(bomb, SIZE), name)
            pyro.process_frame(Frame(number, 8, 8, bomb, 0.0))
            self.assertEqual((pyro.pictures, pyro.bad_pictures), (0, number), name)
        self.assertEqual(self.decoded, [])

    def streamed(self, jpeg: bytes) -> object:
        """Return the frame of a network camera that sends only ``jpeg``."""
        clock = Clock()
        camera = MjpegCamera(clock, MemoryRobot(jpeg=jpeg), 30.0)
        camera.start()
        table = {"url": "http://10.0.0.7:81/stream", "fps": 30}
        driver = create_driver("camera", table, "cam", clock, MemoryConnector(clock, camera.accept))
        driver.connect().addErrback(lambda failure: failure.trap(LinkLost))
        clock.pump([0.01] * 30)
        seen = driver.observe()
        driver.disconnect()
        camera.stop()
        return seen and seen.frame

    def from_folder(self, jpeg: bytes) -> object:
        """Return the frame of a camera that reads a folder with only ``jpeg`` in it."""
        folder = Path(self.mktemp())
        folder.mkdir()
        (folder / "1.jpg").write_bytes(jpeg)
        shots = FolderSource(str(folder))
        shots.open()
        try:
            return shots.read_picture()
        except BadFrame:
            return None

    def on_page(self, jpeg: bytes) -> object:
        """Return the frame that a web node stores for browsers."""
        clock, frames = Clock(), MemoryFrames()
        camera = WebCamera(clock, lambda on_frame: frames.watch("dog", on_frame), lambda: None)
        frames.show("dog", 1, jpeg)
        kept = camera._newest
        camera.close()
        return kept

    def test_no_bomb_is_taken(self) -> None:
        """A camera, a robot, a phone and a page reject all bombs; no bomb is shown or forwarded."""
        for name, bomb in BOMBS.items():
            text = base64.b64encode(bomb).decode()
            self.assertRaises(BadFrame, codec.decode_picture, {"format": "jpeg", "data": text})
            self.assertRaises(Refusal, check_picture, bomb)
            self.assertIsNone(self.streamed(bomb), name)
            self.assertIsNone(self.from_folder(bomb), name)
            self.assertIsNone(self.on_page(bomb), name)
            reader = PictureReader()
            packet = picture.encode_header(0, 1, 208, 160, 1, 1) + picture.encode_block(
                Block(208, 160, "JPEGColor", bomb)
            )
            self.assertEqual((list(reader.read(packet)), reader.bad_frames > 0), ([], True), name)
        good = encoded(208, 156)
        for taken in (self.streamed(good), self.from_folder(good), self.on_page(good)):
            self.assertIsNotNone(taken)

    def test_real_pictures_are_decoded(self) -> None:
        """The target is found in baseline and in progressive pictures.

        Large pictures are decoded at half or a quarter of their width and height.
        """
        for width, height in ((208, 156), (1920, 1080), (MAX_SIDE_PX, MAX_SIDE_PX)):
            for is_progressive in (0, 1) if width < MAX_SIDE_PX else (0,):
                seen = find_target(encoded(width, height, cv2.IMWRITE_JPEG_PROGRESSIVE, is_progressive), SIZE)
                assert seen is not None
                self.assertLess(abs(seen.bearing), 0.02)
                self.assertLessEqual(max(self.decoded[-1]), MAX_DETECTION_SIDE_PX)
        self.assertEqual(len(self.decoded), 5)

    def test_most_that_is_decoded(self) -> None:
        """The limit applies to the number of pixels in all scans of a progressive picture together."""
        most = MAX_DECODED_PX // 1024**2
        self.assertEqual(read_size(of_scans(1024, 1024, most)), (1024, 1024))
        self.assertIsNone(read_size(of_scans(1024, 1024, most + 1)))


class PooledClock(Clock):
    """A clock with a thread pool; the jobs of the pool run when the test calls ``work``."""

    def __init__(self) -> None:
        super().__init__()
        directlyProvides(self, IReactorThreads)
        self.jobs: list[Callable[[], None]] = []

    def getThreadPool(self) -> PooledClock:  # noqa: N802 (Twisted's)
        """Return this object as the thread pool."""
        return self

    def callInThreadWithCallback(self, done: Callable[[bool, object], None], function: Callable[[], object]) -> None:  # noqa: N802 (Twisted's)
        def job() -> None:
            try:
                result = function()
            except Exception:
                done(False, Failure())
            else:
                done(True, result)

        self.jobs.append(job)

    def callFromThread(self, function: Callable[..., object], *arguments: object) -> None:  # noqa: N802 (Twisted's)
        """Call ``function`` immediately, because the test has only one thread."""
        function(*arguments)

    def work(self) -> int:
        """Run the queued jobs; return their number."""
        jobs, self.jobs = self.jobs, []
        for job in jobs:
            job()
        return len(jobs)


class StillDriver:
    """A driver stub with the attributes that a robot reads before it moves."""

    description = describe("camera", {"url": "http://10.0.0.7/"})


class QueueTests(BombCase):
    def test_reactor_decodes_nothing(self) -> None:
        """Of 100 pictures an agent decodes only the first and the newest, both in the thread pool."""
        for kind in ("find-target", "watch-target"):
            with self.subTest(kind=kind):
                clock = PooledClock()
                driver: Any = StillDriver()
                body = AgentRobot(driver, clock, lambda seen: None, lambda why: None)
                behaviour = create_behaviour(Task("t", kind, "t"), random.Random(1), motion=body.motion)
                values = {"odom.x": 0.0, "odom.y": 0.0, "odom.yaw": 0.0}
                self.decoded.clear()
                for number in range(1, 101):
                    frame = Frame(number, 208, 156 + number, encoded(208, 156 + number), 0.0)
                    now = number / 1000
                    behaviour.look(Observation(now, now, values, frame=frame), now)
                self.assertEqual((self.decoded, len(clock.jobs), behaviour.cost), ([], 1, None))
                self.assertEqual([clock.work(), clock.work(), clock.work()], [1, 1, 0])
                self.assertEqual(self.decoded, [(157, 208), (256, 208)])
                for number in range(101, 111):
                    frame, now = Frame(number, 208, 156, encoded(208, 156), 0.0), number / 1000
                    behaviour.look(Observation(now, now, values, frame=frame), now)
                    clock.work()
                self.assertIsNotNone(behaviour.cost)

    def test_queue_of_one(self) -> None:
        """While one picture is searched, a newer picture replaces a waiting one.

        A failure does not stop the detector.
        """
        clock, found = PooledClock(), list[object]()
        detector = Detector(run_in_thread(clock))
        for number in range(50):
            detector.detect(lambda number=number: 1 / number, found.append)  # type: ignore[misc]
        self.assertEqual((len(clock.jobs), detector.dropped), (1, 48))
        self.assertEqual([clock.work(), clock.work(), clock.work()], [1, 1, 0])
        self.assertEqual((found, len(self.flushLoggedErrors(ZeroDivisionError))), ([1 / 49], 1))


class ThreadTests(TestCase):
    async def test_not_in_the_thread_of_the_reactor(self) -> None:
        """With a real reactor, pictures are searched in another thread.

        The result is delivered in the reactor's thread.
        """
        threads: list[int] = []
        done: Deferred[None] = Deferred()

        def find() -> Any:
            threads.append(threading.get_ident())
            return find_target(encoded(208, 156), SIZE)

        def found(sighting: object) -> None:
            threads.append(threading.get_ident())
            self.assertIsNotNone(sighting)
            done.callback(None)

        Detector(run_in_thread(reactor)).detect(find, found)
        await done
        self.assertNotEqual(threads[0], threading.get_ident())
        self.assertEqual(threads[1], threading.get_ident())
