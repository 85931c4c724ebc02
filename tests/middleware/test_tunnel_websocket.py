"""Tests of ``middleware.entangled.network.websocket`` and ``url``: datagrams in WebSocket messages, and tunnel URLs."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.network.network import Address
from middleware.entangled.network.url import Proxy, Url
from middleware.entangled.network.websocket import MAX_PAYLOAD_BYTES, WebSocket
from tests.formats.rfc6455 import CLOSE

URL = Url.parse("wss://node.example:443/swarm")


class WebSocketTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.client = WebSocket(URL)
        self.server = WebSocket()

    def greet(self) -> None:
        """Open both ends."""
        _, answer = self.server.receive_data(self.client.opening())
        self.client.receive_data(answer)
        self.assertTrue(self.client.is_open and self.server.is_open, (self.client.fault, self.server.fault))

    def test_carry_datagrams_cut_anyhow(self) -> None:
        """Datagrams of every length arrive in order in both directions, however the byte stream is split."""
        sizes = [0, 1, 125, 126, 127, 1399, 1400, 1452, MAX_PAYLOAD_BYTES]
        sent = [random.Random(size).randbytes(size) for size in sizes]
        for is_cut in (True, False):
            self.setUp()
            self.greet()
            for source, sink in ((self.client, self.server), (self.server, self.client)):
                stream = b"".join(source.encode_binary(datagram) for datagram in sent)
                pieces = [stream[i : i + 1] for i in range(len(stream))] if is_cut else [stream]
                came = [datagram for piece in pieces for datagram in sink.receive_data(piece)[0]]
                self.assertEqual(came, sent)
                self.assertEqual(sink.fault, "")

    def test_refuse_garbage(self) -> None:
        """A text message, and a message longer than a datagram, close the connection."""
        masked = bytes(4)
        garbage = {
            "text": b"\x81\x80" + masked,
            "too long": b"\x82\xfe"
            + (MAX_PAYLOAD_BYTES + 1).to_bytes(2, "big")
            + masked
            + bytes(MAX_PAYLOAD_BYTES + 1),
            "too long in parts": (b"\x02\xfe\x04\x01" + masked + bytes(0x401))
            + (b"\x00\xfe\x04\x01" + masked + bytes(0x401)),
        }
        for name, stream in garbage.items():
            self.setUp()
            self.greet()
            datagrams, reply = self.server.receive_data(stream)
            self.assertTrue(self.server.fault, name)
            self.assertEqual((datagrams, reply[0] & 0x0F), ([], CLOSE), name)
            self.assertEqual(self.server.receive_data(self.client.encode_binary(b"x")), ([], b""), name)

    def test_refuse_other_requests(self) -> None:
        """A request for a different path, version or subprotocol gets an HTTP error and closes the connection."""
        lawful = self.client.opening()
        for stream, status in (
            (lawful.replace(b"/swarm", b"/admin"), b"404"),
            (lawful.replace(b": 13", b": 8"), b"426"),
            (lawful.replace(b"swarm-tunnel-1", b"chat"), b"426"),
        ):
            server = WebSocket()
            _, reply = server.receive_data(stream)
            self.assertTrue(server.fault and not server.is_open, stream)
            self.assertEqual(reply.split(b" ")[1], status)

    def test_refuse_other_answers(self) -> None:
        """A client rejects a web page, a cached response, and the WebSocket of a different service."""
        for old, new, why in (
            (b"101 Switching Protocols", b"403 Forbidden", "403"),
            (b"swarm-tunnel-1", b"chat", "chat"),
            (b"Sec-WebSocket-Protocol: swarm-tunnel-1\r\n", b"", "but no"),
            (b"Accept: ", b"Accept: x", "token"),
        ):
            client = WebSocket(URL)
            _, lawful = WebSocket().receive_data(client.opening())
            self.assertIn(old, lawful)
            client.receive_data(lawful.replace(old, new))
            self.assertIn(why, client.fault)
            self.assertFalse(client.is_open)

    def test_hear_for_whom_a_proxy_speaks(self) -> None:
        """The last address in X-Forwarded-For is used, because the proxy itself adds this address."""
        head = self.client.opening().replace(b"Upgrade: w", b"X-Forwarded-For: 6.6.6.6, 10.0.0.9\r\nUpgrade: w")
        self.server.receive_data(head)
        self.assertEqual(self.server.forwarded, "10.0.0.9")


class UrlTests(SynchronousTestCase):
    def test_read(self) -> None:
        """Host, port and path are parsed, with defaults for omitted parts, and are converted back to text."""
        for text, parts, again in (
            ("wss://a.example", ("wss", "a.example", 443, "/swarm"), "wss://a.example/swarm"),
            ("ws://127.0.0.1:8000/x", ("ws", "127.0.0.1", 8000, "/x"), "ws://127.0.0.1:8000/x"),
            ("wss://[fe80::1]:8443/swarm", ("wss", "fe80::1", 8443, "/swarm"), "wss://[fe80::1]:8443/swarm"),
        ):
            self.assertEqual((tuple(Url.parse(text)), str(Url.parse(text))), (parts, again))
        for text in (
            "",
            "https://a",
            "wss://",
            "wss://a:0",
            "wss://a:65536",
            "wss://a b",
            "wss://a/\r\nx",
            "wss://a:x",
        ):
            self.assertRaises(ValueError, Url.parse, text)

    def test_address(self) -> None:
        """Each URL has a distinct, stable virtual address."""
        addresses = {Url.parse(text).address for text in ("wss://a", "wss://a:443/swarm", "wss://b", "wss://a:444")}
        self.assertEqual(len(addresses), 3)
        for address in addresses:
            self.assertRegex(address.host, "^~wss-[0-9a-f]{12}$")
            self.assertTrue(address.is_virtual and not Address("10.0.0.1", 7000).is_virtual)

    def test_proxy(self) -> None:
        """The usual values of ``https_proxy`` are parsed, also with a login; no error message contains the login."""
        for text, parts in (
            ("http://10.0.0.1:8080", ("10.0.0.1", 8080, "")),
            ("proxy:3128/", ("proxy", 3128, "")),
            ("http://me:p%40ss@proxy:80/", ("proxy", 80, "me:p@ss")),
            ("http://[fe80::1]:80", ("fe80::1", 80, "")),
        ):
            self.assertEqual(tuple(Proxy.parse(text)), parts)
        for text in ("", "socks5://me:secret@a:1", "http://a:99999", "https://a"):
            self.assertNotIn("secret", str(self.assertRaises(ValueError, Proxy.parse, text)))
