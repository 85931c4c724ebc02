"""Tests of ``swarmnode.tunnels``: the network that results from settings and environment."""

from __future__ import annotations

import random
from typing import Any

from twisted.internet.testing import MemoryReactorClock
from twisted.trial.unittest import SynchronousTestCase

from middleware.config.settings import Settings
from middleware.entangled.clock import HeapClock
from middleware.entangled.network.combined_network import JointNetwork
from middleware.entangled.network.network import Network, find_alternate_paths
from middleware.entangled.network.switchboard import Switchboard
from middleware.entangled.network.url import Proxy, Url
from middleware.faults.network import FaultyNetwork
from swarmnode.tunnels import add_tunnels, find_proxy


class WiringTests(SynchronousTestCase):
    def wired(self, **node: object) -> tuple[Network, list[Any], MemoryReactorClock]:
        """Return the network of a node with these settings, the node's tunnel addresses, and its reactor."""
        settings = Settings.from_mapping({"node": {"name": "a", **node}}, "test").node
        board = Switchboard(HeapClock(), random.Random(1))
        reactor = MemoryReactorClock()
        network = add_tunnels(settings, board.make_network, reactor, random.Random(1), {})()
        network.listen(lambda datagram, source: None)
        self.addCleanup(network.close)
        return network, find_alternate_paths(FaultyNetwork(network, HeapClock(), random.Random(1))), reactor

    def test_nothing_without_tunnels(self) -> None:
        """A node without tunnels and without a tunnel port has a plain network and opens no TCP port."""
        for node in ({}, {"known_nodes": ["127.0.0.1:7000"]}, {"known_nodes": ["10.0.0.7:7000"], "tunnels": []}):
            network, addresses, reactor = self.wired(**node)
            self.assertNotIsInstance(network, JointNetwork)
            self.assertEqual((addresses, reactor.tcpServers), ([], []))

    def test_known_nodes_may_be_dialled(self) -> None:
        """A node has a virtual tunnel address for each known node, but opens no connection at its start."""
        network, addresses, reactor = self.wired(known_nodes=["10.0.0.7:7000"])
        self.assertIsInstance(network, JointNetwork)
        self.assertEqual(addresses, [Url.parse("wss://10.0.0.7").address])
        self.assertEqual((reactor.tcpServers, reactor.tcpClients), ([], []))

    def test_port(self) -> None:
        """The tunnel port is opened on the node's address; it works without TLS only on the loopback address."""
        for tls, host in ((True, "10.0.0.5"), (False, "127.0.0.1")):
            reactor = MemoryReactorClock()
            settings = Settings.from_mapping(
                {"node": {"name": "a", "host": "10.0.0.5", "tunnel_port": 443, "tunnel_tls": tls}}, "test"
            ).node
            board = Switchboard(HeapClock(), random.Random(1))
            opened: list[tuple[int, str]] = []

            def listen_tcp(
                port: int, factory: Any, backlog: int, interface: str, opened: list[tuple[int, str]] = opened
            ) -> Any:
                opened.append((port, interface))
                return _Port()

            reactor.listenTCP = listen_tcp  # type: ignore[method-assign,assignment]
            network = add_tunnels(settings, board.make_network, reactor, random.Random(1), {})()
            network.listen(lambda datagram, source: None)
            network.close()
            self.assertEqual((opened, find_alternate_paths(network)), ([(443, host)], []))

    def test_proxy(self) -> None:
        """A valid proxy in the environment is used for TLS, except for hosts in ``no_proxy``."""
        url, plain = Url.parse("wss://node.example"), Url.parse("ws://node.example")
        said = {"https_proxy": "http://10.0.0.1:8080"}
        self.assertEqual(find_proxy(said, url), Proxy("10.0.0.1", 8080))
        self.assertEqual(find_proxy({"HTTPS_PROXY": "10.0.0.1:8080"}, url), Proxy("10.0.0.1", 8080))
        for environment in ({}, {"https_proxy": ""}, {"https_proxy": "socks5://a:1"}):
            self.assertIsNone(find_proxy(environment, url))
        self.assertIsNone(find_proxy(said, plain))
        for spared, is_used in (("example", False), (".example,a", False), ("*", False), ("ample", True), ("", True)):
            self.assertEqual(find_proxy({**said, "no_proxy": spared}, url) is not None, is_used, spared)


class _Port:
    class socket:  # noqa: N801
        @staticmethod
        def setsockopt(*options: int) -> None:
            """Accept any option."""

    def stopListening(self) -> None:
        """Do nothing."""
