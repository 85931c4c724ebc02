"""Tests of the firewall rules for each kind of NAT."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from sim.namespaces.nat import NatKind


class NatKindTests(SynchronousTestCase):
    def test_what_makes_a_kind(self) -> None:
        """Only SYM has random ports, only LEAKY accepts any packet, only NOUDP drops UDP; FULL and ADDR use DNAT."""
        self.assertEqual([kind for kind in NatKind if "fully-random" in kind.make_rules()], [NatKind.SYM])
        self.assertEqual([kind for kind in NatKind if "ct state new drop" not in kind.make_rules()], [NatKind.LEAKY])
        self.assertEqual([kind for kind in NatKind if "udp drop" in kind.make_rules()], [NatKind.NOUDP])
        self.assertEqual([kind for kind in NatKind if "dnat" in kind.make_rules()], [NatKind.FULL, NatKind.ADDR])
