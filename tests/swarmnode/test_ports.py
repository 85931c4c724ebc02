"""Tests of ``swarmnode.ports``: the choice of ports."""

from __future__ import annotations

import socket
from collections.abc import Collection

from twisted.trial.unittest import SynchronousTestCase

from middleware.config.settings import NODE_PORT, Settings
from swarmnode.ports import PORT_COUNT, IsFree, replace_busy_ports


def busy(*ports: int) -> IsFree:
    """Return the port check of a machine on which these ports are in use."""
    return lambda kind, host, port: port not in ports


def settings(node: Collection[tuple[str, object]] = (), web: Collection[tuple[str, object]] = ()) -> Settings:
    """Return settings of a node with the page."""
    tables = {"node": {"name": "a", "roles": ["web"], **dict(node)}, "web": {"tls": "auto", **dict(web)}}
    return Settings.from_mapping(tables, "a.toml")


class PortsTests(SynchronousTestCase):
    """Tests of ``replace_busy_ports``."""

    def test_free_ports_are_taken_as_usual(self) -> None:
        """If no port is in use, each port has its default value."""
        found = replace_busy_ports(settings(), busy())
        self.assertEqual((found.node.port, found.web.port, found.web.tls_port), (NODE_PORT, 8080, 8443))

    def test_usual_ports_give_way(self) -> None:
        """A default port that is in use is replaced by the next free port."""
        found = replace_busy_ports(settings(), busy(NODE_PORT, NODE_PORT + 1, 8080, 8443))
        self.assertEqual((found.node.port, found.web.port, found.web.tls_port), (NODE_PORT + 2, 8081, 8444))

    def test_many_busy_ports_leave_any(self) -> None:
        """If the next ports are in use as well, the operating system chooses the port."""
        found = replace_busy_ports(settings(), busy(*range(NODE_PORT, NODE_PORT + PORT_COUNT)))
        self.assertEqual(found.node.port, 0)

    def test_a_port_that_was_set_stays(self) -> None:
        """A port from the file or the command line is not replaced, even if it equals the default."""
        of_file = settings([("port", NODE_PORT)], [("port", 8080), ("tls_port", 8443)])
        of_flags = settings().with_flags(port=NODE_PORT, web_port="8080", web_tls_port="8443")
        for wanted in (of_file, of_flags):
            found = replace_busy_ports(wanted, busy(NODE_PORT, 8080, 8443))
            self.assertEqual((found.node.port, found.web.port, found.web.tls_port), (NODE_PORT, 8080, 8443))

    def test_a_node_without_page_looks_for_none(self) -> None:
        """A node without a page does not check the page's ports."""
        asked: list[socket.SocketKind] = []

        def is_free(kind: socket.SocketKind, host: str, port: int) -> bool:
            asked.append(kind)
            return True

        replace_busy_ports(Settings.from_mapping({"node": {"name": "a"}}, ""), is_free)
        self.assertEqual(asked, [socket.SOCK_DGRAM])
