"""Tests of a real page whose clients send slowly or nothing: they are disconnected, and other clients are served."""

from __future__ import annotations

import http.client
import selectors
import socket
import time
from importlib.util import find_spec

from tests.live.page import TeamCase

MISSING = [name for name in ("flask", "cv2") if find_spec(name) is None]
CLOSED_S = 60.0
"""The time limit in seconds for a loaded machine; an idle machine needs 15 s."""
BEGUN = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: "


class Crowd:
    """Slow clients of the page; ``open`` contains the connected clients."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._selector = selectors.DefaultSelector()
        self.open: set[socket.socket] = set()
        self.heard: list[bytes] = []

    def join(self, count: int, begun: bytes, hosts: int = 1, first: int = 1) -> None:
        """Connect ``count`` clients from ``hosts`` addresses, each of which sends the start of a request."""
        for number in range(count):
            client = socket.create_connection(
                ("127.0.0.1", self._port), 5.0, (f"127.0.{first}.{1 + number % hosts}", 0)
            )
            client.setblocking(False)
            if begun:
                client.send(begun)
            self.open.add(client)
            self._selector.register(client, selectors.EVENT_READ)

    def live(self, seconds: float, drip: bytes = b"") -> None:
        """Read all data for ``seconds``; then send ``drip`` from each open client."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            for key, _ in self._selector.select(left):
                client = key.fileobj
                assert isinstance(client, socket.socket)
                try:
                    data = client.recv(65536)
                except OSError:
                    data = b""
                if data:
                    self.heard.append(data)
                else:
                    self._selector.unregister(client)
                    self.open.discard(client)
                    client.close()
        for client in list(self.open):
            try:
                client.send(drip)
            except OSError:
                continue

    def leave(self) -> None:
        """Close all clients."""
        for client in self.open:
            client.close()
        self._selector.close()


class SlowClientTests(TeamCase):
    if MISSING:
        skip = f"SLOW CLIENTS ARE NOT TESTED: missing {', '.join(MISSING)}"

    def setUp(self) -> None:
        super().setUp()
        self.crowd = Crowd(self.team.port)
        self.addCleanup(lambda: self.crowd.leave())

    def ask_state(self) -> None:
        """Request the state; the response must arrive within 10 s."""
        page = http.client.HTTPConnection("127.0.0.1", self.team.port, timeout=10)
        page.request("GET", "/api/v1/state", headers={"Authorization": f"Bearer {self.team.token}"})
        answer = page.getresponse()
        answer.read()
        page.close()
        self.assertEqual(answer.status, 200)

    def test_let_go_who_dribbles(self) -> None:
        """Three hundred clients that send a byte per second are closed in time, while another client is served."""
        began = time.monotonic()
        self.crowd.join(300, BEGUN, hosts=30)
        while self.crowd.open and time.monotonic() - began < CLOSED_S:
            self.crowd.live(1.0, b"x")
            self.ask_state()
        self.assertEqual(len(self.crowd.open), 0)
        self.assertEqual({data[:12] for data in self.crowd.heard}, {b"HTTP/1.1 408"})
