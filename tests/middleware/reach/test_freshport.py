"""Tests of the fresh local ports of a node."""

from __future__ import annotations

from middleware.entangled.reach.way import HELD_S, MAX_FRESH, SHUT_S
from tests.middleware.reach.ground import GroundCase


class FreshPortTests(GroundCase):
    """Behaviour of ``FreshPorts``, of a node that nobody needs one for."""

    def test_so_many_and_no_more(self) -> None:
        """Where all are open there is another one only when the oldest is of no use any more, in its place."""
        ground = self.ground()
        ports = ground.at("a", "none").reach._ports
        opened = [ports.open() for _ in range(MAX_FRESH)]
        self.assertEqual((len(set(opened)), ports.open()), (MAX_FRESH, 0))
        ground.run(HELD_S + 0.1)
        another = ports.open()
        self.assertNotEqual(another, 0)
        self.assertEqual(len(ports), MAX_FRESH)
        self.assertIn(another, ports)
        self.assertEqual([port in ports for port in opened], [False] + [True] * (MAX_FRESH - 1))

    def test_unused_ones_are_shut(self) -> None:
        """A fresh port that led nowhere is closed after a while, and not before."""
        ground = self.ground()
        reach = ground.at("a", "none").reach
        reach._open_port()
        ground.run(SHUT_S - 1.0)
        self.assertEqual(len(reach._ports), 1)
        ground.run(3.0)
        self.assertEqual(len(reach._ports), 0)
