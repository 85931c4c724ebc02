"""Tests of the firewall rules for each kind of NAT."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from sim.namespaces.kind import Kind


class KindTests(SynchronousTestCase):
    def test_what_makes_a_kind(self) -> None:
        """Only SYM has random ports, only LEAKY accepts any packet, only NOUDP drops UDP; FULL and ADDR use DNAT."""
        self.assertEqual([kind for kind in Kind if "fully-random" in kind.rules()], [Kind.SYM])
        self.assertEqual([kind for kind in Kind if "ct state new drop" not in kind.rules()], [Kind.LEAKY])
        self.assertEqual([kind for kind in Kind if "udp drop" in kind.rules()], [Kind.NOUDP])
        self.assertEqual([kind for kind in Kind if "dnat" in kind.rules()], [Kind.FULL, Kind.ADDR])
