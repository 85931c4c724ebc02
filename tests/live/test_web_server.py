"""Tests of the web node on a real port, with Flask and the native streams."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
from typing import Any

from twisted.internet import reactor as _reactor
from twisted.internet.defer import Deferred, maybeDeferred
from twisted.internet.protocol import Protocol
from twisted.internet.task import deferLater
from twisted.trial.unittest import TestCase
from twisted.web.client import Agent, HTTPConnectionPool, readBody
from twisted.web.http_headers import Headers

from tests.webnode.memory import MemoryTeamControl
from tests.webnode.picture import jpeg
from webnode.auth import OpenSessions
from webnode.server import WORKERS, WebService
from webnode.services import Services
from webnode.state import State, format_state

reactor: Any = _reactor


class Stream(Protocol):
    """Collects the data of a stream, and waits for words in the data."""

    def __init__(self) -> None:
        self.data = b""
        self._waiting: list[tuple[bytes, Deferred[bytes]]] = []

    def dataReceived(self, data: bytes) -> None:
        self.data += data
        for entry in [entry for entry in self._waiting if entry[0] in self.data]:
            self._waiting.remove(entry)
            entry[1].callback(self.data)

    def said(self, words: bytes) -> Deferred[bytes]:
        found: Deferred[bytes] = Deferred()
        self._waiting.append((words, found))
        self.dataReceived(b"")
        return found.addTimeout(5, reactor)


def read(connection: socket.socket) -> bytes:
    """Return the data that has arrived but has not been read yet."""
    taken = b""
    with contextlib.suppress(BlockingIOError):
        while data := connection.recv(1 << 16):
            taken += data
    return taken


class WebServiceTests(TestCase):
    timeout = 20

    def setUp(self) -> None:
        self.devices: list[dict[str, Any]] = [{"uuid": "01", "name": "dog1", "joined": 1}]
        self.gate = threading.Event()
        self.gate.set()
        self.held = threading.Event()
        self.control = MemoryTeamControl()
        self.frames = self.control.frames
        self.web = self.service(0)
        self.web.startService()
        self.pool = HTTPConnectionPool(reactor, persistent=False)
        self.agent = Agent(reactor, pool=self.pool, connectTimeout=5)

    async def tearDown(self) -> None:  # type: ignore[override]
        self.gate.set()
        if self.web.running:
            await maybeDeferred(self.web.stopService)
        await self.pool.closeCachedConnections()
        await deferLater(reactor, 0.05)

    def service(self, port: int) -> WebService:
        services = Services(self.control, OpenSessions())
        return WebService(reactor, "127.0.0.1", port, self.read, services, lambda: 1e9)

    def read(self) -> State:
        if threading.current_thread() is not threading.main_thread():
            self.held.set()
            if not self.gate.wait(5):
                raise SystemExit  # end the worker without output
        return format_state(self.devices, [], {}, node="vaio")

    def asked(self, path: str, method: bytes = b"GET") -> Deferred[Any]:
        url = f"http://127.0.0.1:{self.web.port}{path}".encode()
        return self.agent.request(method, url, Headers({"X-Swarm": ["1"]}))

    async def body(self, path: str, method: bytes = b"GET") -> bytes:
        return bytes(await readBody(await self.asked(path, method)))

    async def opened(self, path: str) -> Stream:
        stream = Stream()
        (await self.asked(path)).deliverBody(stream)
        return stream

    async def test_serve_everything(self) -> None:
        """Page, JSON, files, camera frames and changes are served on one port."""
        self.assertIn(b"vaio", await self.body("/"))
        self.assertEqual(json.loads(await self.body("/api/v1/devices"))[0]["name"], "dog1")
        self.assertIn(b"EventSource", await self.body("/static/stream.js"))
        self.assertIn(b"caches", await self.body("/sw.js"))
        asked = self.asked("/shot/01?after=")
        while "01" not in self.frames.watched:
            await deferLater(reactor, 0.01)
        self.frames.show("01", 1, jpeg())
        self.assertEqual(await readBody(await asked), jpeg())
        self.assertEqual(json.loads(await self.body("/api/v1/demo", b"POST")), {"id": "demo-1"})

    async def test_stream_while_workers_are_stuck(self) -> None:
        """While all workers are blocked, states, files and frames are sent; the blocked responses follow later."""
        self.gate.clear()
        held = [self.asked("/api/v1/state") for _ in range(WORKERS + 2)]
        stream = await self.opened("/events")
        await stream.said(b"dog1")
        self.devices.append({"uuid": "02", "name": "dog2", "joined": 2})
        await stream.said(b"dog2")
        self.assertIn(b"EventSource", await self.body("/static/stream.js"))
        self.gate.set()
        for each in held:
            self.assertIn(b"dog2", await readBody(await each))

    async def test_feed_many_pages(self) -> None:
        """Sixty open pages receive their streams, and JSON requests are answered at the same time."""
        streams = [await self.opened("/events") for _ in range(60)]
        self.devices.append({"uuid": "02", "name": "dog2", "joined": 2})
        for stream in streams:
            await stream.said(b"dog2")
        self.assertIn(b"dog2", await self.body("/api/v1/state"))

    async def test_keep_little_for_a_slow_page(self) -> None:
        """Of 1.5 MB for a page that stops reading, less than 200 kB are buffered.

        It receives the newest state later.
        """
        self.devices[0]["description"] = "x" * 250
        self.devices += [{**self.devices[0], "uuid": f"a{n}", "name": f"dog{n}"} for n in range(100)]
        with socket.socket() as slow:
            slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16384)
            slow.setblocking(False)
            slow.connect_ex(("127.0.0.1", self.web.port))
            await deferLater(reactor, 0.1)
            slow.send(b"GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            for n in range(30):
                self.devices = [{**device, "description": f"{n} {'x' * 250}"} for device in self.devices]
                await deferLater(reactor, 0.11)
            taken = held = read(slow)
            while b'"29 xx' not in taken[-60_000:]:
                await deferLater(reactor, 0.01)
                taken += read(slow)
        self.assertLess(len(held), 200_000)
        self.assertLess(len(taken), 400_000)

    async def test_serve_at_further_ports(self) -> None:
        """An additional port serves the same page, and is closed together with the first port."""
        opened: list[Any] = []

        def open_second_port(site: Any) -> Any:
            opened.append(reactor.listenTCP(0, site, interface="127.0.0.1"))
            return opened[0]

        services = Services(self.control, OpenSessions())
        web = WebService(reactor, "127.0.0.1", 0, self.read, services, lambda: 1e9, port_openers=[open_second_port])
        web.startService()
        url = f"http://127.0.0.1:{opened[0].getHost().port}".encode()
        for path, words in ((b"/", b"vaio"), (b"/sw.js", b"caches"), (b"/api/v1/state", b"dog1")):
            self.assertIn(words, await readBody(await self.agent.request(b"GET", url + path)))
        await maybeDeferred(web.stopService)
        self.assertTrue(opened[0].disconnected)

    async def test_stop(self) -> None:
        """Stopping ends streams and waiting requests, frees the port, and leaves no timer."""
        stream = await self.opened("/events")
        await stream.said(b"dog1")
        held = self.asked("/shot/01?after=")
        while "01" not in self.frames.watched:
            await deferLater(reactor, 0.01)
        port = self.web.port
        await maybeDeferred(self.web.stopService)
        self.assertEqual((await held).code, 204)
        self.assertEqual(self.frames.watched, {})
        again = self.service(port)
        again.startService()
        await maybeDeferred(again.stopService)

    async def test_stop_with_an_answer_under_way(self) -> None:
        """A worker that is about to respond does not block the reactor during a stop, and ends."""
        self.gate.clear()
        asked = self.asked("/api/v1/state").addErrback(lambda _: None)
        while not self.held.is_set():
            await deferLater(reactor, 0.01)
        stopped = maybeDeferred(self.web.stopService)
        self.assertNoResult(stopped)
        self.gate.set()
        await stopped
        await asked
