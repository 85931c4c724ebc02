"""An emulated camera board on a simulated robot, which serves MJPEG over HTTP like an ESP32-CAM."""

from __future__ import annotations

import random
from typing import Any

from twisted.internet.interfaces import IReactorTime

from drivers.camera import codec
from drivers.camera.option import parse_options, parse_url
from drivers.errors import UsageError
from drivers.link import Link
from sim.robots.emulator.output import Broadcast, Client, FaultyOutput
from sim.robots.emulator.simulated_robot import SimulatedRobot
from sim.robots.emulator.transport import EmulatorServer, Table, TcpEmulatorServer

MAX_REQUEST_BYTES = 8192
"""Largest request in bytes."""


class _Client(Client):
    def __init__(self, device: Broadcast[Client], link: Link, output: FaultyOutput) -> None:
        super().__init__(device, link, output)
        self.is_watching = False
        self._camera: Any = device
        self._request: bytes | None = b""

    def data_received(self, data: bytes) -> None:
        """Process a request; further data is ignored."""
        if self._request is None:
            return
        self._request += data
        method = codec.parse_method(self._request)
        if method is not None:
            self._request = None
            self._camera.answer(self, method)
        elif len(self._request) > MAX_REQUEST_BYTES:
            self.link.close()


class MjpegCamera(Broadcast[_Client]):
    """One camera, which serves any path.

    ``faults`` corrupts the data. A ``status`` other than ``200 OK`` refuses clients. Without ``has_length`` only
    boundaries separate the pictures. ``is_chunked`` selects chunked encoding, as on an ESP32-CAM. Pictures are dropped
    for a client that does not read them; a robot without a camera sends none.
    """

    make_client = _Client

    def __init__(self, clock: IReactorTime, robot: SimulatedRobot, fps: float = 15.0) -> None:
        super().__init__(clock, robot, fps)
        self.status = "200 OK"
        self.kind = f"{codec.CONTENT_TYPE};boundary={codec.BOUNDARY}"
        self.has_length = True
        self.is_chunked = False
        self.dropped = 0

    def answer(self, client: _Client, method: str) -> None:
        """Answer a request; called by the client."""
        if method != "GET":
            client.output.send(codec.encode_answer_header("text/plain", "405 Method Not Allowed"))
        elif self.status != "200 OK":
            client.output.send(codec.encode_answer_header("text/plain", self.status))
        else:
            client.output.send(codec.encode_answer_header(self.kind, is_chunked=self.is_chunked))
            client.is_watching = True

    def _broadcast(self) -> None:
        watching = [client for client in self.clients if client.is_watching]
        jpeg = self._robot.picture() if watching else None
        if jpeg is None:
            return
        data = codec.encode_part(jpeg, self.has_length)
        data = codec.encode_chunk(data) if self.is_chunked else data
        for client in watching:
            if client.link.is_busy:
                self.dropped += 1
            else:
                client.output.send(data)


def serve(reactor: Any, robot: SimulatedRobot, rng: random.Random, options: Table, dialect: str) -> EmulatorServer:
    """Return the server of a camera; raise ``UsageError`` if ``options`` have no url."""
    args = parse_options(options)
    if not args.url:
        raise UsageError('an emulated camera needs the option url, as in url = "http://127.0.0.1:8081/"')
    place = parse_url(args.url)
    camera = MjpegCamera(reactor, robot, float(options.get("fps", 15.0)))
    return TcpEmulatorServer(reactor, camera, camera.accept, place.host, place.port)
