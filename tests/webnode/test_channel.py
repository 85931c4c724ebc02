"""Tests of ``webnode.channel``: slow senders, slow readers and excess connections are closed."""

from __future__ import annotations

import json
from typing import Any

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase
from twisted.web.http import HTTPChannel, Request
from twisted.web.resource import Resource
from twisted.web.server import NOT_DONE_YET

from tests.webnode.browser import Connection, site_of
from webnode.channel import CLOSE_LIMIT_S, GRACE_S, HEADERS_LIMIT_S, KEEP_ALIVE_S, PACE, STALL_LIMIT_S, Channel
from webnode.limits import AddressLimits
from webnode.request_guard import HEADERS, MAX_BODY

HEAD = b"POST / HTTP/1.1\r\nHost: vaio\r\nContent-Length: %d\r\n\r\n"


class Echo(Resource):
    """A resource that answers GET immediately and POST with the length of the body, and never answers ``/held``."""

    isLeaf = True

    def __init__(self) -> None:
        super().__init__()
        self.held: list[Request] = []
        self.served = 0

    def render_GET(self, request: Request) -> int | bytes:
        if request.path == b"/held":
            self.held.append(request)
            return NOT_DONE_YET
        self.served += 1
        return b"hello"

    def render_POST(self, request: Request) -> bytes:
        self.served += 1
        assert request.content is not None
        return b"%d bytes" % len(request.content.read())


class ChannelTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock = Clock()
        self.limits = AddressLimits({"unfinished": 2, "stream": 2, "open": 5})
        self.echo = Echo()
        self.site = site_of(self.echo, self.clock, self.limits)
        self.connections: list[Connection] = []

    def tearDown(self) -> None:
        for connection in self.connections:
            connection.leave()
        self.assertEqual(self.clock.getDelayedCalls(), [])
        self.assertEqual([self.limits.get_total(kind) for kind in ("unfinished", "stream", "open")], [0, 0, 0])

    def opened(self, address: str = "10.0.0.1") -> Connection:
        self.connections.append(Connection(self.site, address))
        return self.connections[-1]

    def is_closed(self, connection: Connection) -> bool:
        return connection.transport.disconnecting or connection.transport.disconnected

    def assert_refused(self, connection: Connection, status: int, words: str) -> None:
        """Check that the connection received an error in JSON with the usual headers, and was closed."""
        head, _, body = connection.taken().partition(b"\r\n\r\n")
        self.assertTrue(head.startswith(b"HTTP/1.1 %d " % status), head)
        self.assertEqual(set(json.loads(body)["error"]), {"field", "problem", "remedy"})
        self.assertIn(words, body.decode())
        for name, value in HEADERS.items():
            self.assertIn(f"{name}: {value}".encode(), head)
        self.assertTrue(self.is_closed(connection))

    def drip(self, connection: Connection, data: bytes, pause: float) -> float:
        """Send byte by byte with pauses until the connection is closed; return the seconds that passed."""
        began = self.clock.seconds()
        for byte in data:
            if self.is_closed(connection):
                break
            connection.send(bytes([byte]))
            self.clock.advance(pause)
        return self.clock.seconds() - began

    def test_answer_who_sends_whole_requests(self) -> None:
        """Successive, pipelined and fragmented requests, and requests with bodies, share one connection."""
        connection = self.opened()
        for _ in range(3):
            self.assertIn(b"hello", connection.ask("/").taken())
            self.clock.advance(KEEP_ALIVE_S - 1.0)
        connection.send(b"GET / HTTP/1.1\r\nHost: vaio\r\n\r\n" * 3)
        self.assertEqual(connection.taken().count(b"hello"), 3)
        self.drip(connection, HEAD % 5 + b"12345", 0.05)
        self.assertIn(b"5 bytes", connection.taken())
        self.assertEqual(self.echo.served, 7)

    def test_end_who_dribbles_a_head(self) -> None:
        """A connection that sends one byte per second is closed with status 408 ten seconds after its first byte."""
        for before in (False, True):
            connection = self.opened()
            if before:
                connection.ask("/").taken()
            took = self.drip(connection, b"GET / HTTP/1.1\r\nX: " + b"x" * 100, 1.0)
            self.assertEqual(took, HEADERS_LIMIT_S)
            self.assert_refused(connection, 408, "in time")

    def test_end_who_dribbles_a_body(self) -> None:
        """A body that arrives at less than 1 kB/s is rejected after the grace period; a steady body is accepted."""
        slow, steady = self.opened(), self.opened("10.0.0.2")
        slow.send(HEAD % 5000)
        self.assertLess(self.drip(slow, b"x" * 100, 0.5), GRACE_S + 2.0)
        self.assert_refused(slow, 408, "too slowly")
        steady.send(HEAD % 5000)
        for _ in range(10):
            steady.send(b"x" * 500)
            self.clock.advance(500 / PACE)
        self.assertIn(b"5000 bytes", steady.taken())

    def test_end_who_says_nothing(self) -> None:
        """A connection without a request is closed after ten seconds, an idle connection after fifteen."""
        silent, idle = self.opened(), self.opened("10.0.0.2")
        idle.ask("/")
        self.clock.advance(HEADERS_LIMIT_S)
        self.assertTrue(self.is_closed(silent))
        self.assertEqual(silent.taken(), b"")
        self.assertFalse(self.is_closed(idle))
        self.clock.advance(KEEP_ALIVE_S - HEADERS_LIMIT_S)
        self.assertTrue(self.is_closed(idle))

    def test_abort_who_does_not_hang_up(self) -> None:
        """A rejected client that does not close the connection is soon disconnected; its further data is ignored."""
        connection = self.opened()
        connection.send(b"GET / HTTP/1.1\r\n")
        self.clock.advance(HEADERS_LIMIT_S)
        connection.send(b"Host: vaio\r\n\r\n")
        self.assertEqual(self.echo.served, 0)
        self.assertFalse(connection.transport.disconnected)
        self.clock.advance(CLOSE_LIMIT_S)
        self.assertTrue(connection.transport.disconnected)

    def test_end_who_reads_nothing(self) -> None:
        """A client that reads nothing for half a minute is disconnected; a slow reader is not."""
        slow, deaf = self.opened(), self.opened()
        for connection in (slow, deaf):
            connection.ask("/held")
            connection.protocol.pauseProducing()
        self.clock.advance(STALL_LIMIT_S - 1.0)
        slow.protocol.resumeProducing()
        slow.protocol.pauseProducing()
        self.clock.advance(1.0)
        self.assertEqual((slow.transport.disconnected, deaf.transport.disconnected), (False, True))

    def test_bear_few_unfinished_of_an_address(self) -> None:
        """The third incomplete request from an address is rejected.

        Complete requests and other addresses are accepted.
        """
        for _ in range(2):
            self.opened().send(b"GET / HT")
        third = self.opened()
        third.send(b"GET / HT")
        self.assert_refused(third, 503, "incomplete")
        self.assertIn(b"hello", self.opened().ask("/").taken())
        self.assertFalse(self.is_closed(self.opened("10.0.0.2").send(b"GET / HT")))
        self.connections[0].send(b"TP/1.1\r\nHost: vaio\r\n\r\n")
        self.assertIn(b"hello", self.connections[0].taken())
        third.leave()
        self.assertFalse(self.is_closed(self.opened().send(b"GET / HT")))

    def test_bear_some_streams_of_an_address(self) -> None:
        """An address can have two open responses; a third request is rejected until one of the responses has ended."""
        held = [self.opened().ask("/held") for _ in range(2)]
        third = self.opened().ask("/held")
        self.assert_refused(third, 503, "open requests")
        self.assertEqual(len(self.echo.held), 2)
        self.assertIn(b"hello", self.opened("10.0.0.2").ask("/").taken())
        held[0].leave()
        self.assertFalse(self.is_closed(self.opened().ask("/held")))

    def test_bear_some_connections_of_an_address(self) -> None:
        """An address at its limit gets no further connection; a different address does."""
        for _ in range(5):
            self.opened()
        self.assertTrue(self.opened().transport.disconnected)
        self.assertFalse(self.is_closed(self.opened("10.0.0.2")))

    def test_refuse_in_json_with_all_headers(self) -> None:
        """Errors that Twisted detects, and too large bodies, are answered like all other errors."""
        for data, status in (
            (b"nonsense\r\n\r\n", 400),
            (b"GET / HTTP/1.1\r\nno colon\r\n\r\n", 400),
            (b"GET / HTTP/1.1\r\nX: " + b"x" * 20_000 + b"\r\n\r\n", 400),
            (b"POST / HTTP/1.1\r\nContent-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n", 400),
            (b"POST / HTTP/1.1\r\nContent-Length: 5\r\nContent-Length: 6\r\n\r\n", 400),
            (HEAD % (MAX_BODY + 1), 413),
            (b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n" + b"8000\r\n" + b"x" * 0x8000 + b"\r\n"
             b"8001\r\n" + b"x" * 0x8001 + b"\r\n", 413),
        ):  # fmt: skip
            connection = self.opened()
            connection.send(data)
            self.assert_refused(connection, status, "error")
            connection.leave()
        self.assertEqual(self.echo.served, 0)

    def test_be_called_by_twisted(self) -> None:
        """The overridden methods exist in the installed version of Twisted, and Twisted calls them."""
        self.assertTrue(issubclass(Channel, HTTPChannel))
        for name in (
            *("connectionMade", "dataReceived", "allHeadersReceived", "allContentReceived", "requestDone"),
            *("pauseProducing", "resumeProducing", "connectionLost", "_respondToBadRequestAndDisconnect"),
        ):
            self.assertTrue(callable(getattr(HTTPChannel, name, None)), name)
        protocol: Any = self.opened().protocol
        self.assertIsInstance(protocol, Channel)
        self.assertEqual(protocol._dataBuffer, [])
