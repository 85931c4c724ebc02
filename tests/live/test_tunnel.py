"""Tests of real tunnels over loopback: TLS, many clients, slow readers, dead links, and nodes without UDP."""

from __future__ import annotations

import random
import selectors
import socket
import ssl
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from twisted.internet import reactor, task
from twisted.internet.defer import Deferred
from twisted.protocols import portforward
from twisted.trial.unittest import TestCase

from middleware.entangled.contact import Contact
from middleware.entangled.errors import TunnelPortInUse
from middleware.entangled.identity import Identity
from middleware.entangled.network.tcp import TcpTransport
from middleware.entangled.network.tunnel import MAX_HANDSHAKES, MAX_PER_HOST, TunnelNetwork
from middleware.entangled.network.url import Url
from middleware.entangled.wire.endpoint import Endpoint
from sim.demo import free_ports
from tests.live.node import PATIENCE_S, NodeCase
from tests.live.until import takes, until

REACTOR: Any = reactor
HOST = "127.0.0.1"
REQUEST = (
    b"GET /swarm HTTP/1.1\r\nHost: a\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Protocol: swarm-tunnel-1\r\n\r\n"
)


class Forwarder(portforward.ProxyServer):
    """A TCP proxy that can stop forwarding data while both of its connections stay open."""

    is_stuck = False

    def dataReceived(self, data: bytes) -> None:
        """Forward data to the server."""
        if not Forwarder.is_stuck:
            super().dataReceived(data)


class TunnelTests(TestCase):
    timeout = 90

    def setUp(self) -> None:
        self.ports: list[Any] = []
        Forwarder.is_stuck = False

    def made(self, *urls: Url) -> tuple[TunnelNetwork, TcpTransport]:
        """Return a tunnel; without URLs, it listens on a free port."""
        carrier = TcpTransport(reactor, HOST, 0)
        tunnel = TunnelNetwork(carrier, REACTOR, random.SystemRandom(), urls, not urls)

        def close() -> Deferred[Any]:
            tunnel.close()
            return task.deferLater(REACTOR, 0.05, lambda: carrier.closed)

        self.addCleanup(close)
        return tunnel, carrier

    def served(self) -> tuple[Endpoint, TunnelNetwork, Url]:
        """Return an endpoint behind a tunnel, the tunnel, and its URL."""
        tunnel, carrier = self.made()
        end = self.endpoint(1, tunnel)
        return end, tunnel, Url("wss", HOST, carrier.port)

    def endpoint(self, seed: int, tunnel: TunnelNetwork) -> Endpoint:
        """Return a started endpoint of the team."""
        end = Endpoint(Identity(bytes([seed]) * 32), b"k" * 32, tunnel, REACTOR, random.SystemRandom())
        end.expose("echo", lambda peer, value: value)
        end.start()
        self.addCleanup(end.stop)
        return end

    async def until(self, is_so: Callable[[], bool], seconds: float = 15.0) -> float:
        """Wait until ``is_so`` is true; return the elapsed seconds."""
        began = time.monotonic()
        while not is_so() and time.monotonic() - began <= seconds:
            await task.deferLater(REACTOR, 0.05)
        return time.monotonic() - began

    def dialled(self, url: Url) -> ssl.SSLSocket:
        """Return a TLS client that has not started its handshake."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        plain = socket.create_connection((url.host, url.port), 5.0)
        plain.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
        plain.setblocking(False)
        client = context.wrap_socket(plain, do_handshake_on_connect=False)
        self.addCleanup(client.close)
        return client

    async def member(self, url: Url) -> tuple[Endpoint, Contact, TunnelNetwork]:
        """Return an endpoint that has connected to ``url``, the contact of the other endpoint, and the tunnel."""
        tunnel, _ = self.made(url)
        client = self.endpoint(2, tunnel)
        contact = await client.discover(url.address, 4.0)
        return client, contact, tunnel

    async def greet(self, url: Url) -> ssl.SSLSocket:
        """Return a client that has completed the TLS and WebSocket handshakes."""
        client = self.dialled(url)
        for step in (client.do_handshake, lambda: client.send(REQUEST), lambda: client.recv(4096)):
            while True:
                try:
                    step()
                    break
                except (ssl.SSLWantReadError, ssl.SSLWantWriteError):
                    await task.deferLater(REACTOR, 0.01)
        return client

    async def test_endpoints_talk(self) -> None:
        """Two endpoints exchange requests and replies of up to 1 MiB over TLS; the first reply takes less than 1 s."""
        _, _, url = self.served()
        began = time.monotonic()
        client, contact, tunnel = await self.member(url)
        answer = await client.ask(contact, "echo", 42)
        self.assertEqual((contact.public, answer), (Identity(b"\x01" * 32).public, 42))
        self.assertLess(time.monotonic() - began, 1.0)
        large = random.Random(1).randbytes(2**20 - 100)
        answer = await client.ask(contact, "echo", large, timeout=30.0)
        self.assertTrue(answer == large, "1 MiB comes back as it went")
        self.assertEqual(tunnel.counters["opened"], 1, "where nothing is lost one connection is enough")

    async def test_bear_a_crowd(self) -> None:
        """Of five hundred slow clients few are accepted and all are closed in time; meanwhile a member is served."""
        _, tunnel, url = self.served()
        client, contact, _ = await self.member(url)
        crowd: set[socket.socket] = set()
        selector = selectors.DefaultSelector()
        for number in range(500):
            each = socket.socket()
            each.bind((f"127.0.{1 + number // 10 % 25}.{1 + number // 250}", 0))
            each.setblocking(False)
            each.connect_ex((url.host, url.port))
            crowd.add(each)
            selector.register(each, selectors.EVENT_READ)
            self.addCleanup(each.close)
            if number % 25 == 0:
                await task.deferLater(REACTOR, 0.0)
        slowest, most = 0.0, 0
        began = time.monotonic()
        while crowd and time.monotonic() - began < 20.0:
            for each in list(crowd):
                try:
                    each.send(b"\x16")
                except BlockingIOError:
                    pass
                except OSError:
                    crowd.discard(each)
            for key, _ in selector.select(0):
                gone = key.fileobj
                assert isinstance(gone, socket.socket)
                try:
                    is_over = not gone.recv(4096)
                except OSError:
                    is_over = True
                if is_over:
                    selector.unregister(gone)
                    crowd.discard(gone)
            asked = time.monotonic()
            await client.ask(contact, "echo", 1)
            slowest = max(slowest, time.monotonic() - asked)
            most = max(most, len(tunnel._connections))
            await task.deferLater(REACTOR, 0.1)
        selector.close()
        self.assertEqual(len(crowd), 0)
        self.assertLess(time.monotonic() - began, 15.0)
        self.assertLess(slowest, 0.5)
        self.assertLessEqual(most, MAX_HANDSHAKES + 2)

    async def test_bear_one_address(self) -> None:
        """The number of clients per address is limited; each further client is closed immediately."""
        _, tunnel, url = self.served()
        crowd = [socket.create_connection((url.host, url.port), 5.0) for _ in range(100)]
        for each in crowd:
            self.addCleanup(each.close)
        await self.until(lambda: tunnel.counters["crowded"] >= 100 - MAX_PER_HOST)
        self.assertEqual(tunnel.counters["crowded"], 100 - MAX_PER_HOST)

    async def test_garbage(self) -> None:
        """Invalid TLS, handshake or frame data ends only its own link, and raises no exception."""
        _, tunnel, url = self.served()
        client, contact, _ = await self.member(url)
        dice = random.Random(3)
        for _ in range(20):
            plain = socket.create_connection((url.host, url.port), 5.0)
            self.addCleanup(plain.close)
            plain.send(dice.randbytes(dice.randrange(1, 3000)))
        for _ in range(10):
            greeted = await self.greet(url)
            greeted.send(dice.randbytes(dice.randrange(20, 3000)))
        await self.until(lambda: len(tunnel._connections) == 1)
        self.assertEqual(len(tunnel._connections), 1)
        answer = await client.ask(contact, "echo", 1)
        self.assertEqual(answer, 1)

    async def test_slow_reader(self) -> None:
        """For a client that does not read, little data is buffered and the rest dropped.

        Other clients are served fast.
        """
        _, tunnel, url = self.served()
        client, contact, _ = await self.member(url)
        others = set(tunnel.peers)
        await self.greet(url)
        await self.until(lambda: len(tunnel.peers) == 2)
        (slow,) = set(tunnel.peers) - others
        slowest = 0.0
        for _ in range(50):
            for _ in range(100):
                tunnel.send(bytes(1400), slow)
            asked = time.monotonic()
            await client.ask(contact, "echo", 1)
            slowest = max(slowest, time.monotonic() - asked)
        (link,) = (each for each in tunnel._connections if each.address == slow)
        transport: Any = link.transport
        held = link.queued_bytes + len(transport.dataBuffer) + transport._tempDataLen - transport.offset
        self.assertLess(held, 64 * 1024)
        self.assertGreater(link.dropped, 4000)
        self.assertLess(slowest, 0.3)

    async def test_strain(self) -> None:
        """On Linux the link metrics show a backlog if the client does not read, and none if all data is confirmed."""
        if sys.platform != "linux":
            self.skipTest("only Linux tells")
        server, tunnel, url = self.served()
        client_tunnel, carrier = self.made(url)
        client = self.endpoint(2, client_tunnel)
        contact = await client.discover(url.address, 4.0)
        await client.ask(contact, "echo", 1)
        await task.deferLater(REACTOR, 0.3)
        (link,) = client_tunnel._connections
        strain = carrier.read_state(link.transport)
        assert strain is not None
        self.assertEqual((strain.unacked, strain.retransmissions), (0, 0))
        self.assertGreater(strain.acked, 1000)
        await self.greet(url)
        (deaf,) = (each for each in tunnel._connections if each.address != tunnel.peers[0])
        for _ in range(400):
            tunnel.send(bytes(1400), deaf.address)
            await task.deferLater(REACTOR, 0.001)
        strain = carrier.read_state(deaf.transport)
        assert strain is not None
        self.assertGreater(strain.unacked, 8192)
        deaf.close("the test is over", is_rude=True)
        self.assertIsNone(carrier.read_state(None))
        server.stop()

    async def test_dead_end(self) -> None:
        """A link that is open but transmits no data is closed within 12 s, and then opened again."""
        server, tunnel, url = self.served()

        factory = portforward.ProxyFactory(HOST, url.port)
        factory.protocol = Forwarder
        factory.noisy = False
        front = REACTOR.listenTCP(0, factory, interface=HOST)
        self.addCleanup(front.stopListening)
        through = Url("wss", HOST, front.getHost().port)
        client, contact, client_tunnel = await self.member(through)
        await client.ask(contact, "echo", 1)
        Forwarder.is_stuck = True
        calls = task.LoopingCall(client_tunnel.send, b"there?", through.address)
        calls.start(0.2)
        took = await self.until(lambda: not client_tunnel.peers)
        Forwarder.is_stuck = False
        calls.stop()
        self.assertLess(took, 12.0)
        await task.deferLater(REACTOR, 1.0)
        again = await client.discover(through.address, 4.0)
        self.assertEqual(again.public, contact.public)
        client.stop()
        server.stop()
        await task.deferLater(REACTOR, 0.2)

    def test_port_in_use(self) -> None:
        """A port in use is refused with one line that contains the setting and the remedy."""
        with socket.socket() as taken:
            taken.bind((HOST, 0))
            taken.listen()
            carrier = TcpTransport(reactor, HOST, taken.getsockname()[1])
            error = self.assertRaises(TunnelPortInUse, carrier.listen, lambda host: None)
        self.assertIn("choose another port", str(error))
        self.assertNotIn("\n", str(error))


class NodeTests(NodeCase):
    def joins(self, name: str, text: str) -> Any:
        """Start a real node with these settings."""
        path = self.file(f'[node]\nname = "{name}"\nteam_key = "of these tests"\n{text}', name)
        child = self.popen("--config", path)
        self.addCleanup(child.communicate)
        self.addCleanup(child.kill)
        return child

    def test_enter_without_udp(self) -> None:
        """If its known node does not reply over UDP, a real node joins the team over TLS."""
        (number,) = free_ports.find_free_ports("tcp", HOST, 1)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
            silent.bind((HOST, 0))
            known = f'known_nodes = ["{HOST}:{silent.getsockname()[1]}"]\n'
            self.joins("b", f'roles = ["bootstrap"]\ntunnel_port = {number}\n')
            until(lambda: takes(number))
            child = self.joins("a", f'{known}tunnels = ["wss://{HOST}:{number}"]\n')
            silent.settimeout(PATIENCE_S)
            silent.recv(2000)
            lines = []
            for line in child.stdout:
                lines.append(line)
                if "joined" in line:
                    break
            maps = Path(f"/proc/{child.pid}/maps").read_text(encoding="ascii")
        text = "".join(lines)
        self.assertIn(f"tunnel to wss://{HOST}:{number}/swarm opened", text)
        self.assertNotIn("cryptography", maps, "Python's own TLS is enough")
