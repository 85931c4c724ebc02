"""Tests of ``webnode.tls``: the port for TLS, its certificate, and slow handshakes."""

from __future__ import annotations

import os
import random
import socket
import ssl
import stat
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from twisted.internet.address import IPv4Address
from twisted.internet.error import CannotListenError
from twisted.internet.task import Clock
from twisted.internet.testing import MemoryReactorClock, StringTransport
from twisted.logger import capturedLogs, formatEvent
from twisted.trial.unittest import SynchronousTestCase
from twisted.web.resource import Resource
from twisted.web.static import Data

from middleware.entangled.data.memory import MemoryStore
from tests.webnode.browser import Connection, site_of
from webnode.channel import CLOSE_LIMIT_S, HEADERS_LIMIT_S
from webnode.errors import PortTaken
from webnode.limits import AddressLimits
from webnode.live import KERNEL_BUFFER_BYTES, SEND_BUFFER_BYTES, Viewer

MISSING = [name for name in ("OpenSSL", "cryptography") if find_spec(name) is None]
if not MISSING:
    from middleware.config.settings import Settings
    from webnode.certificate import make_authority, make_leaf, parse_leaf
    from webnode.keyfile import write_key_file
    from webnode.tls import CertificateProvider, TlsPort, make_tls_port

SKIP = f"TLS IS NOT TESTED: missing {', '.join(MISSING)} (pip install 'swarm-node[tls]')"
NOW = 1.8e9
NO_CHECK_TIME = 0x200000
"""X509_V_FLAG_NO_CHECK_TIME of OpenSSL, because the certificate is valid at the test's time, not at the real time."""
DAY = 86400.0


class CertificateProviderTests(SynchronousTestCase):
    if MISSING:
        skip = SKIP

    def setUp(self) -> None:
        folder = Path(self.mktemp())
        folder.mkdir()
        self.path = folder / "a.sqlite.tls"
        self.signer = make_authority(b"1" * 32, "a")
        self.names = ["192.168.0.7"]
        self.now = NOW

    def provider(self, seed: int = 1) -> tuple[CertificateProvider, str]:
        """Return the certificate provider of a node after its start, and the node's log lines."""
        with capturedLogs() as said:
            made = CertificateProvider(
                self.signer, "a", self.path, lambda: self.names, lambda: self.now, random.Random(seed)
            )
        return made, "\n".join(formatEvent(each) for each in said)

    def served(self, provider: CertificateProvider) -> list[str]:
        """Return the names in the certificate after the next connection."""
        provider.serverConnectionForTLS(None)
        return provider.names

    def test_make_it_once(self) -> None:
        """The first start writes a private certificate file, which the next start uses."""
        _, said = self.provider()
        self.assertIn("no certificate exists yet", said)
        pem = self.path.read_bytes()
        self.assertEqual(stat.S_IMODE(self.path.stat().st_mode), 0o600)
        self.assertEqual(set(parse_leaf(pem).names), {"localhost", "127.0.0.1", "::1", "192.168.0.7"})
        self.assertEqual(self.provider(2)[1], "")
        self.assertEqual(self.path.read_bytes(), pem)

    def test_make_it_anew(self) -> None:
        """A certificate that is exposed, truncated, old, incomplete or of a different authority is replaced.

        The log contains the reason.
        """

        def cut() -> None:
            self.path.write_bytes(self.path.read_bytes()[:300])

        def moved() -> None:
            self.names = ["192.168.0.8"]

        def sworn() -> None:
            self.signer = make_authority(b"2" * 32, "a")

        def aged() -> None:
            self.now += 340 * DAY

        faults: list[tuple[Any, str]] = [
            (lambda: self.path.chmod(0o644), "other users can read"),
            (cut, "does not contain a certificate"),
            (lambda: self.path.write_bytes(b""), "does not contain a certificate"),
            (moved, "the certificate lacks 192.168.0.8"),
            (sworn, "another authority"),
            (aged, "the certificate expires soon"),
        ]
        for seed, (fault, words) in enumerate(faults):
            self.provider(seed)
            before = parse_leaf(self.path.read_bytes()).certificate.serial_number
            fault()
            _, said = self.provider(100 + seed)
            self.assertIn(words, said)
            self.assertIn("is replaced", said)
            self.assertNotEqual(parse_leaf(self.path.read_bytes()).certificate.serial_number, before)
            self.assertEqual(stat.S_IMODE(self.path.stat().st_mode), 0o600)

    def test_go_on_without_a_place(self) -> None:
        """If the certificate cannot be stored, it is used nevertheless; the log contains the reason."""
        self.path = self.path.parent / "nowhere" / "a.tls"
        provider, said = self.provider()
        self.assertIn("cannot store", said)
        self.assertIn("192.168.0.7", self.served(provider))

    def test_follow_the_machine(self) -> None:
        """A running node replaces its certificate when local addresses are added, and before the certificate ends."""
        provider, _ = self.provider()
        self.names = ["10.0.0.5"]
        self.assertNotIn("10.0.0.5", provider.names)
        self.assertIn("10.0.0.5", self.served(provider))
        provider.add_reached("172.16.0.9")
        self.assertIn("172.16.0.9", self.served(provider))
        provider.add_reached("8.8.8.8")
        before = self.path.read_bytes()
        self.served(provider)
        self.assertEqual(self.path.read_bytes(), before)
        self.now += 340 * DAY
        self.served(provider)
        self.assertNotEqual(self.path.read_bytes(), before)

    def test_look_once_a_minute(self) -> None:
        """The node checks its addresses at most once per minute, however many connections there are."""
        provider, _ = self.provider()
        looks: list[int] = []
        provider._names = lambda: looks.append(1) or self.names  # type: ignore[func-returns-value]
        for _ in range(100):
            self.now += 0.5
            provider.serverConnectionForTLS(None)
        self.assertEqual(len(looks), 1)
        self.now -= 3600.0
        provider.serverConnectionForTLS(None)
        self.assertEqual(len(looks), 2)


class TlsPortTests(SynchronousTestCase):
    if MISSING:
        skip = SKIP

    def setUp(self) -> None:
        self.folder = Path(self.mktemp()).resolve()
        self.folder.mkdir()

    def tls_port(self, store: str = "a.sqlite", kept: MemoryStore | None = None, seed: int = 1) -> TlsPort:
        node = {"name": "a", "roles": ["web"], "store": store, "team_key": "of a test"}
        settings = Settings.from_mapping({"node": node, "web": {"tls": "auto"}}, str(self.folder / "a.toml"))
        return make_tls_port(
            settings,
            MemoryStore() if kept is None else kept,
            Clock(),
            lambda: NOW,
            random.Random(seed),
            lambda: ["192.168.0.7"],
        )

    def test_have_an_authority_of_its_own(self) -> None:
        """Each node has its own authority, which is the same after a restart."""
        kept = MemoryStore()
        first = self.tls_port("a.sqlite", kept)
        self.assertEqual(self.tls_port("a.sqlite", kept, 2).signer.pem, first.signer.pem)
        self.assertNotEqual(self.tls_port("b.sqlite", seed=3).signer.pem, first.signer.pem)
        self.assertEqual(sorted(os.listdir(self.folder)), ["a.sqlite.tls", "b.sqlite.tls"])

    def test_migrate(self) -> None:
        """A certificate that an authority of an earlier version signed is replaced."""
        path = self.folder / "a.sqlite.tls"
        old = make_leaf(make_authority(b"7" * 32, "a"), "a", ["192.168.0.7"], NOW, random.Random(1))
        write_key_file(path, old.pem_with_key)
        made = self.tls_port()
        self.assertEqual(parse_leaf(path.read_bytes()).find_flaw(made.signer, ["192.168.0.7"], NOW), "")

    def test_keep_nothing_in_memory(self) -> None:
        """A node with a store in memory writes no file."""
        self.tls_port(store=":memory:")
        self.assertEqual(os.listdir(self.folder), [])

    def test_tell_of_a_taken_port(self) -> None:
        """If the port is in use, the error contains the setting of the port."""

        class Taken(MemoryReactorClock):
            def listenTCP(self, port: int, *others: Any, **more: Any) -> Any:  # noqa: N802
                raise CannotListenError("", port, OSError(98, "Address already in use"))

        entrance = self.tls_port()
        entrance._reactor = Taken()
        words = str(self.assertRaises(PortTaken, entrance.open, site_of(Data(b"hi", "text/plain"), Clock())))
        self.assertIn("127.0.0.1:8443", words)
        self.assertIn("choose another tls_port", words)


class Line(StringTransport):
    """A TCP transport in memory."""

    def setTcpNoDelay(self, enabled: bool) -> None:  # noqa: N802
        """Do nothing."""


class HandshakeTests(SynchronousTestCase):
    """A real TLS client connects to the port in virtual time, without a socket."""

    if MISSING:
        skip = SKIP

    def setUp(self) -> None:
        self.signer = make_authority(b"1" * 32, "a")
        self.reactor = MemoryReactorClock()
        provider = CertificateProvider(self.signer, "a", None, lambda: ["10.0.0.9"], lambda: NOW, random.Random(1))
        self.limits = AddressLimits()
        root = Resource()
        root.putChild(b"page", Data(b"hello", "text/plain"))
        self.site: Any = site_of(root, self.reactor, self.limits)
        TlsPort(self.reactor, "127.0.0.1", 8443, self.signer, provider).open(self.site)
        self.connections = self.reactor.tcpServers[0][1]

    def connected(self) -> Connection:
        """Return a connection that has not received any data yet."""
        connection = Connection.__new__(Connection)
        local = IPv4Address("TCP", "10.0.0.9", 8443)
        connection.transport = Line(hostAddress=local, peerAddress=IPv4Address("TCP", "10.0.0.1", 54321))
        connection.protocol = self.connections.buildProtocol(connection.transport.getPeer())
        connection.protocol.makeConnection(connection.transport)
        return connection

    def client(self, **versions: ssl.TLSVersion) -> tuple[ssl.SSLObject, ssl.MemoryBIO, ssl.MemoryBIO]:
        """Return a TLS client that trusts the authority and checks the address."""
        context = ssl.create_default_context(cadata=self.signer.pem.decode())
        context.maximum_version = versions.get("newest", ssl.TLSVersion.MAXIMUM_SUPPORTED)
        context.minimum_version = ssl.TLSVersion.MINIMUM_SUPPORTED
        context.verify_flags |= NO_CHECK_TIME
        incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        return context.wrap_bio(incoming, outgoing, server_hostname="10.0.0.9"), incoming, outgoing

    def test_answer_over_tls(self) -> None:
        """A client that trusts the authority receives the page over HTTP/1.1 with TLS 1.2 and 1.3."""
        for newest in (ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3):
            self.assertIn(b"hello", self.asked(newest))

    def test_refuse_old_tls(self) -> None:
        """TLS 1.1 is rejected."""
        self.assertRaises(ssl.SSLError, self.asked, ssl.TLSVersion.TLSv1_1)

    def asked(self, newest: ssl.TLSVersion) -> bytes:
        """Return the response to one request."""
        connection = self.connected()
        client, incoming, outgoing = self.client(newest=newest)
        is_asked = False
        for _ in range(10):
            try:
                if not is_asked:
                    client.do_handshake()
                    client.write(b"GET /page HTTP/1.1\r\nHost: 10.0.0.9\r\nConnection: close\r\n\r\n")
                    is_asked = True
                answer: bytes = client.read()
            except ssl.SSLWantReadError:
                connection.send(outgoing.read())
                self.reactor.advance(0.0)
                self.reactor.advance(0.0)
                incoming.write(connection.taken())
            else:
                return answer
        return b""

    def test_let_little_wait_for_a_slow_reader(self) -> None:
        """With TLS the send buffers are as small as without TLS, because the option is set on the socket below TLS."""
        connection = self.connected()
        with socket.socket() as below:
            connection.transport.getHandle = lambda: below  # type: ignore[attr-defined]
            request: Any = SimpleNamespace(channel=SimpleNamespace(transport=connection.protocol))
            Viewer(request).shrink_buffers()
            # Linux reports twice the requested value.
            self.assertLessEqual(below.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF), 2 * KERNEL_BUFFER_BYTES)
        self.assertEqual(connection.transport.bufferSize, SEND_BUFFER_BYTES)  # type: ignore[attr-defined]
        connection.leave()

    def test_let_go_who_dribbles_a_handshake(self) -> None:
        """A silent or slow handshake is closed in time; no connection and no timer remain."""
        client, _, outgoing = self.client()
        self.assertRaises(ssl.SSLWantReadError, client.do_handshake)
        hello = outgoing.read()
        silent, dribbler = self.connected(), self.connected()
        for second in range(int(HEADERS_LIMIT_S + CLOSE_LIMIT_S) + 1):
            if not dribbler.transport.disconnecting and not dribbler.transport.disconnected:
                dribbler.send(hello[second : second + 1])
            self.reactor.advance(1.0)
        for connection in (silent, dribbler):
            self.assertTrue(connection.transport.disconnected or connection.transport.disconnecting)
            connection.leave()
        self.assertEqual(self.limits.get_total("open"), 0)
        self.assertEqual([call for call in self.reactor.getDelayedCalls() if call.getTime() > 60], [])
