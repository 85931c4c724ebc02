"""Tests of the firewall rules for each kind of NAT."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from sim.namespaces.nat import NatKind


class NatKindTests(SynchronousTestCase):
    def test_what_makes_a_kind(self) -> None:
        """Of the kinds of NAT, only SYM has random ports, only LEAKY accepts any packet, and only NOUDP drops UDP.

        The rules of FULL and ADDR contain a destination NAT (DNAT).
        """
        self.assertEqual([kind for kind in NatKind if "fully-random" in kind.make_rules()], [NatKind.SYM])
        self.assertEqual([kind for kind in NatKind if "ct state new drop" not in kind.make_rules()], [NatKind.LEAKY])
        self.assertEqual([kind for kind in NatKind if "udp drop" in kind.make_rules()], [NatKind.NOUDP])
        self.assertEqual([kind for kind in NatKind if "dnat" in kind.make_rules()], [NatKind.FULL, NatKind.ADDR])
