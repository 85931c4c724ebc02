"""Tests of camera streams over real sockets.

The driver reads the stream of a server that is not the emulator; OpenCV's client reads the stream of the emulator.
"""

from __future__ import annotations

import http.server
import threading
from importlib.util import find_spec
from typing import Any

from twisted.internet import reactor as running
from twisted.internet.threads import deferToThread
from twisted.trial.unittest import TestCase

from drivers.driver import Driver
from drivers.link import TcpLinkFactory
from drivers.registry import create_driver
from sim.robots.emulator.camera import MjpegCamera
from sim.robots.emulator.simulated_robot import MemoryRobot
from tests.drivers.test_camera_driver import jpeg
from tests.live.waiting import until, wait

reactor: Any = running


class LiveMjpegTests(TestCase):
    """Real sockets in real time."""

    timeout = 60

    def setUp(self) -> None:
        self.body = MemoryRobot(jpeg=jpeg(1))
        self.camera = MjpegCamera(reactor, self.body, 30.0)
        self.camera.start()
        self.port = reactor.listenTCP(0, TcpLinkFactory(self.camera.accept), interface="127.0.0.1")
        self.number = self.port.getHost().port

        self.addCleanup(self.close)

    async def close(self) -> None:
        """Stop the camera and close its port."""
        self.camera.stop()
        await self.port.stopListening()
        await wait(0.05)

    def driver(self, port: int, **options: object) -> Driver:
        """Return a driver of the camera at ``port``."""
        url = f"http://127.0.0.1:{port}/stream"
        return create_driver("camera", {"url": url, "width": 128, "height": 96, "fps": 30, **options}, "cam", reactor)

    async def test_watches_a_server_of_others(self) -> None:
        """The driver reads a stream of Python's HTTP server, which uses HTTP/1.0 and sends no lengths."""

        class Page(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:  # noqa: N802 (its own)
                self.send_response(200)
                self.send_header("Content-Type", 'multipart/x-mixed-replace; boundary="--edge"')
                self.end_headers()
                for mark in range(20):
                    self.wfile.write(b"--edge\nContent-Type: image/jpeg\n\n" + jpeg(mark) + b"\n")
                self.wfile.write(b"--edge--\n")

            def log_message(self, *_: Any) -> None:
                """Log nothing."""

        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Page)
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        driver = self.driver(server.server_port)
        try:
            await driver.connect()
            await until(lambda: driver.diagnostics()["refused"] >= 1)
            seen = driver.diagnostics()
            self.assertEqual(seen["pictures"] + seen["dropped"], 20)
        finally:
            await driver.disconnect()
            await deferToThread(server.shutdown)
            server.server_close()
            thread.join(5.0)

    async def test_other_clients_watch_the_emulator(self) -> None:
        """OpenCV's client reads the emulated camera with and without chunks."""
        import cv2
        import numpy

        made, data = cv2.imencode(".jpg", numpy.full((96, 128, 3), 200, numpy.uint8))
        self.assertTrue(made)
        self.body.jpeg = data.tobytes()

        def watch() -> list[tuple[int, ...]]:
            capture = cv2.VideoCapture(f"http://127.0.0.1:{self.number}/stream.mjpg")
            shapes = [tuple(capture.read()[1].shape) for _ in range(5)]
            capture.release()
            return shapes

        for is_chunked in (False, True):
            self.camera.is_chunked = is_chunked
            shapes = await deferToThread(watch)
            self.assertEqual(shapes, [(96, 128, 3)] * 5)

    if find_spec("cv2") is None:
        test_other_clients_watch_the_emulator.skip = "OTHER CLIENTS ARE NOT TESTED: install the extra vision"  # type: ignore[attr-defined]
