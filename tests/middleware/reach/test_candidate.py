"""Tests of candidates: which addresses that others name are worth a try, and who is near."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.network.network import Address
from middleware.entangled.reach.candidate import MAX_CANDIDATES, is_loopback, is_near, packed, unpacked


class CandidateTests(SynchronousTestCase):
    """Behaviour of the functions of ``candidate``."""

    def test_there_and_back(self) -> None:
        """Addresses of both families come back as they went, each once, and no more than there may be."""
        addresses = [Address("203.0.113.1", 7000), Address("2001:db8::1", 1), Address("192.168.1.2", 65535)]
        self.assertEqual(unpacked(packed([*addresses, *addresses])), addresses)
        many = [Address("203.0.113.1", port) for port in range(1, 50)]
        self.assertEqual(unpacked([list(address) for address in many]), many[:MAX_CANDIDATES])

    def test_what_no_peer_can_have(self) -> None:
        """Groups, any, all, names, carried ways, odd ports and what is no list at all are left out."""
        hosts = ["224.0.0.1", "ff02::1", "0.0.0.0", "::", "255.255.255.255", "localhost", "~" + "0" * 40, "", "1" * 99]
        for host in hosts:
            self.assertEqual(unpacked([[host, 7000]]), [], host)
        odd: list[object] = [None, 7, "x", [7], [[]], [["203.0.113.1"]], [["203.0.113.1", 0]], [["203.0.113.1", "7"]]]
        for fields in odd:
            self.assertEqual(unpacked(fields), [], repr(fields))
        self.assertEqual(unpacked([["203.0.113.1", 65536], [b"203.0.113.1", 1], ["203.0.113.1", True]]), [])

    def test_near(self) -> None:
        """One machine and one site's own network are near; public hosts, other sites and other families are not."""
        near = [("127.0.0.1", "192.168.1.2"), ("192.168.1.9", "192.168.1.2"), ("10.0.7.1", "10.0.9.1")]
        near += [("203.0.113.1", "203.0.113.1"), ("fe80::1", "fe80::2"), ("fd00::1", "fd00::2")]
        far = [("203.0.113.1", "203.0.113.2"), ("192.168.1.2", "10.0.0.1"), ("192.168.1.2", "192.169.1.2")]
        far += [("10.1.0.1", "10.2.0.1"), ("2001:db8::1", "2001:db8::2"), ("::ffff", "1.2.3.4"), ("x", "127.0.0.1")]
        self.assertEqual([pair for pair in near if not is_near(*pair)], [])
        self.assertEqual([pair for pair in far if is_near(*pair)], [])
        self.assertFalse(is_near("10.0.7.1", "10.0.9.1", is_translated=True))
        self.assertTrue(is_near("10.0.9.7", "10.0.9.1", is_translated=True))

    def test_loopback(self) -> None:
        """Both families have a loopback; a name is none."""
        self.assertEqual(
            [is_loopback(host) for host in ("127.0.0.9", "::1", "10.0.0.1", "x")], [True, True] + [False] * 2
        )
