"""Tests of ``drivers.rosbridge.websocket``: the opening handshake and its errors."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from drivers.rosbridge.websocket import WebSocket
from formats.head import MAX_HEAD_BYTES
from tests.formats.rfc6455 import answer_to


class GreetingTests(SynchronousTestCase):
    def test_asks_for_its_path(self) -> None:
        """The request contains path and host, and the emulated rosbridge accepts it."""
        said = WebSocket("server.example.com", "/chat").opening()
        self.assertTrue(said.startswith(b"GET /chat HTTP/1.1\r\nHost: server.example.com\r\n"))
        server = WebSocket()
        self.assertTrue(server.receive_data(said)[1].startswith(b"HTTP/1.1 101 "))
        self.assertTrue(server.is_open)

    def test_names_what_answers_instead(self) -> None:
        """A server of another protocol, a wrong key and endless headers are faults; each contains its reason."""
        for said, reason in (
            (b"HTTP/1.1 404 Not Found\r\n\r\n", "404"),
            (b"SSH-2.0-OpenSSH_9\r\n\r\n", "SSH-2.0"),
            (answer_to(WebSocket("x").opening()), "no rosbridge"),
            (b"HTTP/1.1 1" + b"0" * (MAX_HEAD_BYTES + 1), "longer than"),
        ):
            one = WebSocket("h")
            answer = answer_to(one.opening())
            self.assertEqual(one.receive_data(said), ([], b""))
            self.assertIn(reason, one.fault)
            self.assertFalse(one.is_open)
            self.assertEqual(one.receive_data(answer), ([], b""))

    def test_turns_a_browser_away(self) -> None:
        """A request without an upgrade or without a key gets status 400."""
        for said in (b"GET / HTTP/1.1\r\nHost: h\r\n\r\n", b"POST / HTTP/1.1\r\nUpgrade: websocket\r\n\r\n"):
            one = WebSocket()
            self.assertTrue(one.receive_data(said)[1].startswith(b"HTTP/1.1 400"))
            self.assertTrue(one.fault)
