"""Tests of ``drivers.rosbridge.websocket``: whom it greets, what it hears, and what it says last."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from drivers.rosbridge.websocket import MAX_MESSAGE, WebSocket
from standards.head import MAX_HEAD
from standards.websocket import BINARY, CLOSE, PING, TEXT, framed
from tests.standards.rfc6455 import ANSWER, MASK, nonce


def client() -> WebSocket:
    """One that has been greeted."""
    one = WebSocket(nonce, "server.example.com", "/chat")
    one.received(ANSWER)
    return one


class GreetingTests(SynchronousTestCase):
    def test_greets_as_the_rfc_shows(self) -> None:
        """The request has the key of section 1.3, whose answer is the one shown there."""
        said = WebSocket(nonce, "server.example.com", "/chat").opening()
        self.assertEqual(
            said,
            b"GET /chat HTTP/1.1\r\nHost: server.example.com\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n",
        )
        server = WebSocket(nonce, is_client=False)
        self.assertEqual(server.received(said), ([], ANSWER))
        self.assertTrue(server.is_open)

    def test_names_what_answers_instead(self) -> None:
        """Another server, a proxy that answers anew and endless noise are faults that say what was met."""
        for said, reason in (
            (b"HTTP/1.1 404 Not Found\r\n\r\n", "404 Not Found"),
            (b"SSH-2.0-OpenSSH_9\r\n\r\n", "SSH-2.0"),
            (b"\r\n\r\n", "no rosbridge"),
            (ANSWER.replace(b"s3p", b"xxx"), "proxy"),
            (ANSWER.replace(b"Upgrade: websocket", b"Upgrade: h2c"), "proxy"),
            (b"x" * (MAX_HEAD + 1), "no end"),
        ):
            one = WebSocket(nonce, "h")
            self.assertEqual(one.received(said), ([], b""))
            self.assertIn(reason, one.fault)
            self.assertFalse(one.is_open)
            self.assertEqual(one.received(ANSWER), ([], b""))

    def test_turns_a_browser_away(self) -> None:
        """A request without the upgrade, or without a key, gets 400."""
        for said in (b"GET / HTTP/1.1\r\nHost: h\r\n\r\n", b"POST / HTTP/1.1\r\nUpgrade: websocket\r\n\r\n"):
            one = WebSocket(nonce, is_client=False)
            self.assertTrue(one.received(said)[1].startswith(b"HTTP/1.1 400"))
            self.assertTrue(one.fault)


class MessageTests(SynchronousTestCase):
    def test_hears_text_and_pictures(self) -> None:
        """Messages of both kinds are heard, those of the largest pictures too; a server's words are not masked."""
        one = client()
        said = [b"{}", bytes(MAX_MESSAGE)]
        heard = one.received(framed(TEXT, said[0], None) + framed(BINARY, said[1], None) + framed(PING, b"", None))
        self.assertEqual(heard, (said, framed(0xA, b"", MASK)))
        self.assertEqual((one.text(b"{}"), one.frames), (framed(TEXT, b"{}", MASK), 3))
        self.assertEqual(WebSocket(nonce, is_client=False).text(b"{}"), framed(TEXT, b"{}", None))

    def test_says_goodbye(self) -> None:
        """A close is answered with its code; what breaks the rules is not answered."""
        one = client()
        self.assertEqual(one.received(framed(CLOSE, b"\x03\xe8bye", None)), ([], framed(CLOSE, b"\x03\xe8", MASK)))
        other = client()
        self.assertEqual(other.received(b"\x82\x7f" + (MAX_MESSAGE + 1).to_bytes(8, "big")), ([], b""))
        self.assertIn("more than", other.fault)
