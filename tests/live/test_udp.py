"""Tests of the real UDP network over the loopback interface."""

from __future__ import annotations

import random
from collections.abc import Generator
from typing import Any

from twisted.internet import reactor
from twisted.internet.defer import Deferred, inlineCallbacks
from twisted.trial.unittest import TestCase

from middleware.entangled.errors import PortInUse
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import MAX_RELAYED_BYTES, Address
from middleware.entangled.network.udp import UdpNetwork
from middleware.entangled.wire.endpoint import Endpoint


class UdpTests(TestCase):
    """Tests of ``UdpNetwork``."""

    def network(self, host: str = "127.0.0.1") -> UdpNetwork:
        """Return a network on a free port, which is closed after the test."""
        network = UdpNetwork(reactor, host, 0)

        def close() -> Deferred[Any]:
            network.close()
            return network.closed

        self.addCleanup(close)
        return network

    @inlineCallbacks
    def test_endpoints_talk(self) -> Generator[Deferred[Any], Any, None]:
        """Two endpoints exchange requests and replies of up to 1 MiB over real sockets."""
        ends = []
        for seed in (1, 2):
            end = Endpoint(Identity(bytes([seed]) * 32), b"k" * 32, self.network(), reactor, random.SystemRandom())
            end.start()
            self.addCleanup(end.stop)
            ends.append(end)
        ends[1].expose("twice", lambda peer, number: 2 * number, changes=True)
        contact = yield ends[0].discover(ends[1].address)
        self.assertEqual(contact.public, Identity(b"\x02" * 32).public)
        answer = yield ends[0].ask(contact, "twice", 21, changes=True)
        self.assertEqual(answer, 42)
        large = random.Random(1).randbytes(2**20)
        ends[1].expose("echo", lambda peer, value: value)
        answer = yield ends[0].ask(contact, "echo", large)
        self.assertTrue(answer == large, "1 MiB comes back as it went")

    def test_port_in_use(self) -> None:
        """A port in use is refused with one line that contains the port and a remedy."""
        first = self.network()
        first.listen(lambda datagram, source: None)
        self.assertNotEqual(first.address.port, 0)
        second = UdpNetwork(reactor, "127.0.0.1", first.address.port)
        error = self.assertRaises(PortInUse, second.listen, lambda datagram, source: None)
        self.assertIn(f"127.0.0.1:{first.address.port}", str(error))
        self.assertNotIn("\n", str(error))

    def test_what_cannot_be_sent_is_counted(self) -> None:
        """Datagrams to invalid addresses, too large ones, and datagrams at a closed port are counted.

        They raise no exception.
        """
        network = self.network()
        network.send(b"x", Address("127.0.0.1", 9))
        network.listen(lambda datagram, source: None)
        for address in [Address("a name", 9), Address("::1", 9), Address("127.0.0.1", 99999), Address("127.0.0.1", -1)]:
            network.send(b"x", address)
        network.send(bytes(MAX_RELAYED_BYTES + 1), Address("127.0.0.1", 9))
        self.assertEqual((network.counters["unsent"], network.counters["oversized"]), (5, 1))
        network.close()
        network.close()

    @inlineCallbacks
    def test_every_interface(self) -> Generator[Deferred[Any], Any, None]:
        """A network at "*" listens on one port for IPv4 and IPv6, and replies with the IP version of the request."""
        wide = self.network("*")
        wide.listen(lambda datagram, source: wide.send(datagram + b" too", source))
        self.assertNotIn(wide.address.host, ("*", "0.0.0.0", "::"))
        for host in ("127.0.0.1", "::1"):
            heard: Deferred[bytes] = Deferred()
            near = self.network(host)
            near.listen(lambda datagram, source, heard=heard: heard.callback(datagram))  # type: ignore[misc]
            near.send(b"me", Address(host, wide.address.port))
            answer = yield heard.addTimeout(5.0, reactor)
            self.assertEqual(answer, b"me too")

    @inlineCallbacks
    def test_further_ports(self) -> Generator[Deferred[Any], Any, None]:
        """Datagrams to a peer can be sent from an additional port.

        An unknown sender gets its reply from the port to which it sent.
        """
        one, other = self.network(), self.network()
        heard: list[Address] = []
        arrived: Deferred[None] = Deferred()

        def hear(datagram: bytes, source: Address) -> None:
            heard.append(source)
            if len(heard) == 3:
                arrived.callback(None)

        other.listen(hear)
        one.listen(lambda datagram, source: one.send(datagram, source))
        port = one.open_port()
        self.assertEqual(one.assign_port(other.address, port), 0)
        one.send(b"1", other.address)
        self.assertEqual(one.source_address(other.address), Address("127.0.0.1", port))
        self.assertEqual(one.assign_port(other.address, 0), port)
        one.send(b"2", other.address)
        stranger = self.network()
        answered: Deferred[Address] = Deferred()
        stranger.listen(lambda datagram, source: answered.callback(source))
        stranger.send(b"x", Address("127.0.0.1", port))
        source = yield answered.addTimeout(5.0, reactor)
        self.assertEqual(source.port, port)
        one.close_port(port)
        one.send(b"3", other.address)
        yield arrived.addTimeout(5.0, reactor)
        self.assertEqual([address.port for address in heard], [port, one.address.port, one.address.port])
