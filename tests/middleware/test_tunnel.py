"""Tests of tunnels and of the layers below tunnels, in virtual time."""

from __future__ import annotations

import random
from importlib.util import find_spec
from typing import Any

from twisted.internet.protocol import Protocol
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from middleware.entangled.errors import PortInUse
from middleware.entangled.network.combined_network import JointNetwork
from middleware.entangled.network.layer import ProxyLayer, TlsLayer, make_client_context, make_server_context
from middleware.entangled.network.memory_streams import PipeNetwork
from middleware.entangled.network.network import Address
from middleware.entangled.network.selfsigned import make_certificate
from middleware.entangled.network.switchboard import Switchboard
from middleware.entangled.network.tunnel import (
    ACCEPT_TIMEOUT_S,
    IDLE_TIMEOUT_S,
    MAX_HANDSHAKES,
    MAX_PER_HOST,
    MAX_REDIAL_S,
    MAX_TOTAL_CONNECTIONS,
    MIN_REDIAL_S,
    UNANSWERED_TIMEOUT_S,
    TunnelNetwork,
)
from middleware.entangled.network.tunnel_connection import MAX_QUEUED_BYTES, MAX_SEND_BUFFER_BYTES
from middleware.entangled.network.url import Proxy, Url

HOST = "10.0.0.1"
URL = Url("wss", HOST, 443)
PLAIN = Url("ws", HOST, 443)
Heard = list[tuple[bytes, Address]]
GREETING = (
    b"GET /swarm HTTP/1.1\r\nHost: a\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: swarm-tunnel-1\r\nX-Forwarded-For: 9.9.9.%d\r\n\r\n"
)


class Dribbler(Protocol):
    """A peer that sends fixed bytes and then nothing."""

    def __init__(self, words: bytes = b"") -> None:
        self.words = words
        self.heard = b""
        self.is_lost = False

    def connectionMade(self) -> None:
        """Send the bytes."""
        transport: Any = self.transport
        transport.write(self.words)

    def dataReceived(self, data: bytes) -> None:
        """Store the received bytes."""
        self.heard += data

    def connectionLost(self, reason: Any = None) -> None:
        """Record the loss of the connection."""
        self.is_lost = True


class Relay(Protocol):
    """An HTTP proxy that accepts one CONNECT request and forwards all later bytes."""

    def __init__(self, pipes: PipeNetwork, answer: bytes = b"HTTP/1.1 200 Connection established\r\n\r\n") -> None:
        self.pipes = pipes
        self.answer = answer
        self.asked = b""
        self.far: Protocol | None = None

    def dataReceived(self, data: bytes) -> None:
        """Accept the request, then forward."""
        transport: Any = self.transport
        if self.far is not None:
            far: Any = self.far.transport
            far.write(data)
            return
        self.asked += data
        if b"\r\n\r\n" in self.asked:
            transport.write(self.answer)
            self.far = Protocol()
            self.far.dataReceived = transport.write  # type: ignore[method-assign]
            self.pipes.make_transport("10.0.0.250").dial(Address(HOST, 443), self.far, lambda why: None)


class TunnelCase(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock = HeapClock()
        self.pipes = PipeNetwork(self.clock)
        self.ends: list[TunnelNetwork] = []
        self.addCleanup(self.end)

    def end(self) -> None:
        """Close all ends and check that no timer is left."""
        for end in self.ends:
            end.close()
        self.clock.advance(10.0)
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def made(self, host: str = HOST, *urls: Url, port: int = 443, **options: Any) -> tuple[TunnelNetwork, Heard]:
        """Return a new end, and the list of datagrams that it receives; an end without a URL is a server."""
        heard: Heard = []
        stream = self.pipes.make_transport(host, port)
        tunnel = TunnelNetwork(stream, self.clock, random.Random(host), urls, not urls, **options)
        tunnel.listen(lambda datagram, source: heard.append((datagram, source)))
        self.ends.append(tunnel)
        return tunnel, heard

    def pair(self, url: Url = PLAIN) -> tuple[TunnelNetwork, Heard, TunnelNetwork, Heard]:
        """Return two ends with an open tunnel between them."""
        server, served = self.made(is_plain=not url.is_tls)
        client, came = self.made("10.0.0.2", url)
        client.send(b"hello", url.address)
        self.clock.advance(0.01)
        self.assertEqual([datagram for datagram, _ in served], [b"hello"])
        server.send(b"hello", served[0][1])
        self.clock.advance(0.01)
        self.assertEqual(came, [(b"hello", url.address)])
        served.clear()
        came.clear()
        return client, came, server, served

    def dribble(self, words: bytes = b"", host: str = "10.6.6.6") -> Dribbler:
        """Connect a peer that sends these bytes and then nothing."""
        dribbler = Dribbler(words)
        self.pipes.make_transport(host).dial(Address(HOST, 443), dribbler, lambda why: None)
        self.clock.advance(0.0)
        self.clock.advance(0.0)
        return dribbler


class TunnelTests(TunnelCase):
    def test_carry_both_ways(self) -> None:
        """A datagram to the address of a URL opens a tunnel.

        Datagrams arrive in both directions, with and without TLS.
        """
        for url in (URL, PLAIN):
            dialled = len(self.pipes.dialled)
            client, came, server, served = self.pair(url)
            self.assertEqual(len(self.pipes.dialled), dialled + 1)
            for size in (1, 200, 1400):
                client.send(b"q" * size, url.address)
                self.clock.advance(0.01)
                datagram, source = served.pop()
                self.assertEqual(datagram, b"q" * size)
                self.assertRegex(source.host, "^~wss-[0-9a-f]{12}$")
                server.send(b"a" * size, source)
                self.clock.advance(0.01)
                self.assertEqual(came.pop(), (b"a" * size, url.address))
            self.assertEqual((client.counters["sent"], client.counters["received"]), (4, 4))
            client.close()
            server.close()
            self.clock.advance(1.0)

    def test_unknown_addresses(self) -> None:
        """A datagram to an address without a tunnel is counted and dropped."""
        client, _ = self.made("10.0.0.2", URL)
        for address in (Address("~wss-000000000000", 1), Address("10.0.0.1", 443), Address("~", 1)):
            client.send(b"x", address)
        client.send(bytes(5000), URL.address)
        client.close()
        client.send(b"x", URL.address)
        self.assertEqual(client.counters["unsent"], 5)

    def test_back_off(self) -> None:
        """If a URL is unreachable, later datagrams try it again at increasing intervals."""
        client, _ = self.made("10.0.0.2", URL)
        moments = []
        for _ in range(1200):
            before = len(self.pipes.dialled)
            client.send(b"x", URL.address)
            if len(self.pipes.dialled) > before:
                moments.append(self.clock.seconds())
            self.clock.advance(0.05)
        gaps = [b - a for a, b in zip(moments, moments[1:], strict=False)]
        self.assertLess(gaps[0], 1.25 * MIN_REDIAL_S + 0.1)
        self.assertLess(max(gaps), 1.25 * MAX_REDIAL_S + 0.1)
        self.assertGreater(gaps[-1], 0.75 * MAX_REDIAL_S - 0.1)
        self.assertLess(len(moments), 15)

    def test_reconnect(self) -> None:
        """After a restart of its server a tunnel is opened again, and transfers datagrams within a second."""
        client, _, server, _ = self.pair(URL)
        self.clock.advance(11.0)
        server.close()
        self.clock.advance(0.1)
        self.assertEqual(client.peers, [])
        _, served = self.made()
        for _ in range(20):
            client.send(b"again", URL.address)
            self.clock.advance(0.05)
        self.assertIn(b"again", [datagram for datagram, _ in served])

    def test_let_go_unused(self) -> None:
        """The client closes a tunnel that had no traffic for a minute, and keeps a tunnel in use."""
        client, _, server, served = self.pair()
        for _ in range(10):
            self.clock.advance(20.0)
            client.send(b"x", PLAIN.address)
        self.assertEqual(len(client.peers), 1)
        self.clock.advance(IDLE_TIMEOUT_S - 2.0)
        self.assertEqual((len(client.peers), len(server.peers)), (1, 1))
        self.clock.advance(4.0)
        self.assertEqual((client.peers, server.peers), ([], []))
        self.assertEqual(len(self.pipes.dialled), 1)

    def test_notice_half_open(self) -> None:
        """A half-open connection is detected, soon by an end that sends datagrams, otherwise by pings."""
        client, _, server, served = self.pair()
        self.clock.advance(1.0)
        self.pipes.cut(HOST)
        for _ in range(24):
            self.clock.advance(0.5)
            client.send(b"there?", PLAIN.address)
        self.assertEqual(client.peers, [])
        self.assertEqual(len(server.peers), 1)
        self.clock.advance(20.0)
        self.assertEqual(server.peers, [])

    def test_port_in_use(self) -> None:
        """A port in use raises ``PortInUse``; then a network that joins UDP and tunnels opens neither of them."""
        self.made()
        stream = self.pipes.make_transport(HOST, 443)
        other = TunnelNetwork(stream, self.clock, random.Random(1), is_served=True)
        self.assertRaises(PortInUse, other.listen, lambda datagram, source: None)
        udp = Switchboard(self.clock, random.Random(1)).make_network(HOST, 7000)
        self.assertRaises(PortInUse, JointNetwork(udp, other).listen, lambda datagram, source: None)
        self.assertIsNone(udp.receiver)

    def test_through_a_proxy(self) -> None:
        """If an HTTP proxy is configured, the tunnel uses CONNECT and the credentials for the proxy."""
        _, served = self.made()
        relay = Relay(self.pipes)
        self.pipes.make_transport("10.0.0.200", 3128).listen(lambda host: relay)
        client, _ = self.made("10.0.0.2", URL, proxy_for=lambda url: Proxy("10.0.0.200", 3128, "me:secret"))
        client.send(b"through", URL.address)
        self.clock.advance(0.1)
        self.assertEqual([datagram for datagram, _ in served], [b"through"])
        self.assertTrue(relay.asked.startswith(b"CONNECT 10.0.0.1:443 HTTP/1.1\r\n"))
        self.assertIn(b"Proxy-Authorization: Basic bWU6c2VjcmV0\r\n", relay.asked)

    def test_proxy_says_no(self) -> None:
        """After a rejection or an invalid reply of the proxy, the proxy layer sets ``fault`` and does not open."""
        for answer in (
            b"HTTP/1.1 407 Proxy Authentication Required\r\n\r\n",
            b"SSH-2.0-box\r\n\r\n",
            b"\r\n\r\n",
            b"x" * 9000,
        ):
            layer = ProxyLayer("a:443")
            layer.decode(answer)
            self.assertTrue(layer.fault and not layer.is_open)
        layer = ProxyLayer("a:443")
        self.assertEqual(layer.decode(b"HTTP/1.1 200 OK\r\n\r\nrest"), (b"rest", b""))


class QueueLimitTests(TunnelCase):
    """Tests of a tunnel server under load by slow readers, incomplete handshakes and unknown peers."""

    def test_slow_reader(self) -> None:
        """For a peer that does not read, at most 64 KiB are queued, and the newest datagrams are dropped."""
        client, came, server, _ = self.pair()
        (address,) = server.peers
        reader = self.pipes.streams[0]
        reader.is_reading = False
        for number in range(500):
            server.send(number.to_bytes(2, "big") * 700, address)
        (link,) = server._connections
        self.assertLess(link.queued_bytes + len(reader.other.buffer), 64 * 1024)
        self.assertLessEqual(link.queued_bytes, MAX_QUEUED_BYTES)
        self.assertGreater(server.counters["dropped"], 450)
        reader.is_reading = True
        reader.other.pump()
        self.clock.advance(1.0)
        numbers = [int.from_bytes(datagram[:2], "big") for datagram, _ in came]
        self.assertEqual(numbers, list(range(len(numbers))))
        self.assertTrue(20 < len(numbers) < 60, len(numbers))

    def test_deaf_talker(self) -> None:
        """A peer that sends but does not read is disconnected after half a minute."""
        server, served = self.made(is_plain=True)
        talker = self.dribble(GREETING % 1, "127.0.0.1")
        self.clock.advance(0.1)
        self.pipes.streams[0].is_reading = False
        (address,) = server.peers
        for second in range(40):
            for _ in range(1 if second else 20):
                server.send(bytes(1400), address)
            transport: Any = talker.transport
            transport.write(b"\x8a\x80" + bytes(4))
            self.clock.advance(1.0)
            if second == 25:
                self.assertEqual(server.peers, [address])
        self.assertEqual(server.peers, [])

    def test_heartbeats_pass_bulk(self) -> None:
        """On a saturated link of 50 kB/s, short datagrams overtake long ones and arrive within half a second."""
        client, came, server, served = self.pair()
        self.pipes.rate = 50_000.0
        late: list[float] = []

        def receive(datagram: bytes, source: Address) -> None:
            if len(datagram) == 100:
                late.append(self.clock.seconds() - int.from_bytes(datagram[:8], "big") / 1e6)

        server._receiver = receive
        for _ in range(100):
            for _ in range(10):
                client.send(bytes(1400), PLAIN.address)
            client.send(round(self.clock.seconds() * 1e6).to_bytes(8, "big") + bytes(92), PLAIN.address)
            self.clock.advance(0.1)
        self.clock.advance(2.0)
        self.assertEqual(len(late), 100)
        self.assertLess(max(late), (MAX_SEND_BUFFER_BYTES + 8192) / 50_000.0)
        self.assertGreater(client.counters["dropped"], 500)

    def test_garbage_is_let_go(self) -> None:
        """A peer without TLS or WebSocket is disconnected immediately; an incomplete handshake ends by a timeout."""
        server, _ = self.made()
        idle, half = self.dribble(), self.dribble(b"\x16\x03\x01")
        self.clock.advance(ACCEPT_TIMEOUT_S - 1.0)
        self.assertFalse(idle.is_lost or half.is_lost)
        self.clock.advance(2.1)
        self.assertTrue(idle.is_lost and half.is_lost)
        server.counters.clear()
        self.dribble(b"GET / HTTP/1.1\r\n\r\n")
        self.clock.advance(0.1)

        self.assertEqual(server.counters["refused"], 1)
        server.close()
        self.clock.advance(3.0)
        server, _ = self.made(is_plain=True)
        page = self.dribble(b"GET / HTTP/1.1\r\nHost: a\r\n\r\n")
        self.clock.advance(0.1)
        self.assertTrue(page.is_lost and page.heard.startswith(b"HTTP/1.1 400"))

    def test_bear_one_address(self) -> None:
        """The number of connections per address is limited; other addresses can still connect."""
        server, _ = self.made()
        crowd = [self.dribble() for _ in range(100)]
        self.clock.advance(0.1)
        self.assertEqual(sum(not one.is_lost for one in crowd), MAX_PER_HOST)
        client, _ = self.made("10.0.0.2", URL)
        client.send(b"x", URL.address)
        self.clock.advance(0.1)
        self.assertEqual(len(client.peers), 1)

    def test_bear_many_addresses(self) -> None:
        """The total number of incomplete handshakes is limited, but a member can still connect."""
        server, served = self.made()
        crowd = [self.dribble(host=f"10.7.{n // 250}.{n % 250}") for n in range(500)]
        self.assertEqual(sum(not one.is_lost for one in crowd), MAX_HANDSHAKES)
        client, _ = self.made("10.0.0.2", URL)
        client.send(b"x", URL.address)
        self.clock.advance(0.1)
        self.assertEqual([datagram for datagram, _ in served], [b"x"])
        self.clock.advance(ACCEPT_TIMEOUT_S + 2.0)
        self.assertTrue(all(one.is_lost for one in crowd))
        self.assertEqual(len(server._connections), 1)

    def test_behind_a_reverse_proxy(self) -> None:
        """Behind a reverse proxy connections are counted by the forwarded address."""
        server, _ = self.made(is_plain=True)
        one = [self.dribble(GREETING % 1, "127.0.0.1") for _ in range(40)]
        others = [self.dribble(GREETING % n, "127.0.0.1") for n in range(2, 12)]
        self.clock.advance(0.5)
        self.assertEqual(sum(not each.is_lost for each in one), MAX_PER_HOST)
        self.assertFalse(any(each.is_lost for each in others))

    def test_strangers_are_let_go(self) -> None:
        """A peer to which the node never replies is disconnected; a peer that gets replies stays connected."""
        client, _, server, served = self.pair()
        stranger, _ = self.made("10.0.0.3", PLAIN)
        for second in range(int(UNANSWERED_TIMEOUT_S) + 2):
            if second < UNANSWERED_TIMEOUT_S:
                stranger.send(b"garbage", PLAIN.address)
            client.send(b"x", PLAIN.address)
            self.clock.advance(1.0)
        self.assertEqual(stranger.peers, [])
        self.assertEqual((len(client.peers), len(server.peers)), (1, 1))

    def test_full_house(self) -> None:
        """If all connections are in use, a new one replaces the connection of an unknown peer, never of a member."""
        server, served = self.made(is_plain=True)
        members = []
        for n in range(MAX_TOTAL_CONNECTIONS - 1):
            member, _ = self.made(f"10.1.{n // 250}.{n % 250}", PLAIN)
            member.send(b"m", PLAIN.address)
            self.clock.advance(0.0)
            self.clock.advance(0.01)
            server.send(b"hello", served.pop()[1])
            members.append(member)
        stranger, _ = self.made("10.0.0.3", PLAIN)
        stranger.send(b"garbage", PLAIN.address)
        self.clock.advance(0.01)
        late, _ = self.made("10.0.0.4", PLAIN)
        late.send(b"x", PLAIN.address)
        self.clock.advance(0.01)
        self.assertEqual((len(stranger.peers), len(late.peers)), (0, 1))
        server.send(b"hello", served[-1][1])
        latest, _ = self.made("10.0.0.5", PLAIN)
        latest.send(b"x", PLAIN.address)
        self.clock.advance(0.01)
        self.assertEqual((len(latest.peers), len(late.peers)), (0, 1))
        self.assertTrue(all(member.peers for member in members))


class JointTests(TunnelCase):
    def test_pick_by_address(self) -> None:
        """A joint network sends to tunnel addresses by tunnel and to other addresses by UDP.

        It has one receiver for both.
        """
        switchboard = Switchboard(self.clock, random.Random(1))
        server, served = self.made()
        plain = switchboard.make_network("10.0.0.9", 7000)
        by_udp: Heard = []
        plain.listen(lambda datagram, source: by_udp.append((datagram, source)))
        tunnel = TunnelNetwork(self.pipes.make_transport("10.0.0.2"), self.clock, random.Random(2), [URL])
        joint = JointNetwork(switchboard.make_network("10.0.0.2", 7000), tunnel)
        heard: Heard = []
        joint.listen(lambda datagram, source: heard.append((datagram, source)))
        self.addCleanup(joint.close)
        joint.send(b"udp", plain.address)
        joint.send(b"tunnel", URL.address)
        self.clock.advance(0.1)
        self.assertEqual(by_udp, [(b"udp", joint.address)])
        server.send(b"back", served[0][1])
        plain.send(b"back", joint.address)
        self.clock.advance(0.1)
        self.assertEqual(sorted(heard), [(b"back", plain.address), (b"back", URL.address)])
        self.assertEqual(joint.counters["sent"], 1)  # the switchboard counts the datagrams of all its ports together
        self.assertEqual(joint.counters["tunnel opened"], 1)
        joint.close()
        joint.close()


PEM = make_certificate(b"s" * 32, b"number 1", "node.example")


class CertificateTests(SynchronousTestCase):
    if find_spec("cryptography") is None:
        skip = "the certificate is not read by another library: no cryptography"

    def test_others_read_it(self) -> None:
        """A different library can read the key and the certificate, which match, and can verify the signature."""
        from cryptography import x509
        from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_private_key

        key = load_pem_private_key(PEM.encode(), None)
        certificate = x509.load_pem_x509_certificate(PEM.encode())
        raw = Encoding.Raw, PublicFormat.Raw
        self.assertEqual(key.public_key().public_bytes(*raw), certificate.public_key().public_bytes(*raw))
        certificate.verify_directly_issued_by(certificate)
        self.assertEqual(certificate.serial_number, int.from_bytes(b"\x01number 1"))
        self.assertEqual(certificate.subject.rfc4514_string(), "CN=node.example")
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        self.assertEqual([name.value for name in names], ["node.example"])


class TlsTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.client = TlsLayer(make_client_context(), "node.example")
        self.server = TlsLayer(make_server_context(PEM), is_server=True)

    def shake(self) -> None:
        """Complete the handshake."""
        said = self.client.opening()
        while not (self.client.is_open and self.server.is_open):
            _, answer = self.server.decode(said)
            _, said = self.client.decode(answer)
            self.assertEqual((self.client.fault, self.server.fault), ("", ""))
        self.server.decode(said)

    def test_carry(self) -> None:
        """After the handshake, bytes are encrypted in transit and arrive unchanged, for any split into segments."""
        self.shake()
        for source, sink in ((self.client, self.server), (self.server, self.client)):
            wrapped = source.encode(b"in the clear" * 3000)
            self.assertNotIn(b"clear", wrapped)
            came = b"".join(sink.decode(wrapped[at : at + 997])[0] for at in range(0, len(wrapped), 997))
            self.assertEqual(came, b"in the clear" * 3000)

    def test_fault(self) -> None:
        """After input that is not TLS, or a modified record, the TLS layer sets ``fault`` and raises no exception."""
        self.server.decode(b"GET / HTTP/1.1\r\n\r\n")
        self.assertIn("TLS", self.server.fault)
        self.assertEqual(self.server.decode(b"more")[0], b"")
        self.setUp()
        self.shake()
        wrapped = bytearray(self.client.encode(b"x" * 100))
        wrapped[-1] ^= 1
        self.assertEqual(self.server.decode(bytes(wrapped))[0], b"")
        self.assertIn("TLS", self.server.fault)
        self.assertEqual(self.server.encode(b"late")[:0], b"")
