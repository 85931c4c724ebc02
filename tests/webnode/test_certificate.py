"""Tests of ``webnode.certificate``: each web node has an authority that is limited to the local network."""

from __future__ import annotations

import ipaddress
import random
from datetime import UTC, datetime, timedelta
from importlib.util import find_spec
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

MISSING = find_spec("cryptography") is None
if not MISSING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import rsa
    from cryptography.hazmat.primitives.hashes import SHA256
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
    from cryptography.x509.verification import PolicyBuilder, Store, VerificationError

    from webnode.certificate import (
        RENEWAL_MARGIN,
        VALIDITY,
        Authority,
        Leaf,
        filter_names,
        make_authority,
        make_leaf,
        parse_leaf,
    )

SKIP = "CERTIFICATES ARE NOT TESTED: missing cryptography (pip install 'swarm-node[tls]')"
NOW = datetime(2026, 11, 22, tzinfo=UTC).timestamp()
DAY = 86400.0
SECRET = bytes(range(32))


class AuthorityTests(SynchronousTestCase):
    if MISSING:
        skip = SKIP

    def test_be_the_same_after_each_start(self) -> None:
        """Equal secrets give exactly equal authorities; a different secret gives a different authority and name."""
        first, second, other = (
            make_authority(SECRET, "vaio"),
            make_authority(SECRET, "vaio"),
            make_authority(bytes(32), "vaio"),
        )
        self.assertEqual(first.pem, second.pem)
        self.assertTrue(first.fingerprint.startswith("BC:95:A9:E3:43:30"), first.fingerprint)
        self.assertNotEqual(other.fingerprint, first.fingerprint)
        self.assertNotEqual(other.certificate.subject, first.certificate.subject)

    def test_vouch_for_the_local_network_alone(self) -> None:
        """A client accepts the authority's certificates for private addresses and local names, not for public sites."""
        signer = make_authority(SECRET, "vaio")
        for name in ("192.168.0.7", "10.1.2.3", "127.0.0.1", "fd00::7", "vaio.local", "vaio.home.arpa", "localhost"):
            self.assertTrue(
                self.is_believed(signer, make_leaf(signer, "vaio", [name], NOW, random.Random(1)), name), name
            )
        for name in ("example.org", "local.example.org", "8.8.8.8", "2001:db8::7"):
            self.assertFalse(self.is_believed(signer, forged(signer, name), name), name)
            self.assertNotIn(name, filter_names([name]))

    def is_believed(self, signer: Authority, made: Leaf, name: str) -> bool:
        """Return whether a strict client that trusts the authority accepts the certificate for ``name``."""
        try:
            wanted: Any = x509.IPAddress(ipaddress.ip_address(name))
        except ValueError:
            wanted = x509.DNSName(name)
        moment = datetime.fromtimestamp(NOW, UTC)
        verifier = PolicyBuilder().store(Store([signer.certificate])).time(moment).build_server_verifier(wanted)
        try:
            verifier.verify(made.certificate, [])
        except VerificationError:
            return False
        return True


class LeafTests(SynchronousTestCase):
    if MISSING:
        skip = SKIP

    def setUp(self) -> None:
        self.signer = make_authority(SECRET, "vaio")
        self.names = ["192.168.0.7", "vaio.local"]
        self.leaf = make_leaf(self.signer, "vaio", self.names, NOW, random.Random(1))

    def flaw(self, now: float = NOW, names: list[str] | None = None) -> str:
        return self.leaf.find_flaw(self.signer, self.names if names is None else names, now)

    def test_serve_for_a_year_less_a_month(self) -> None:
        """A certificate has a flaw before its start, and from a month before its end; it has none in between."""
        self.assertEqual(self.flaw(), "")
        self.assertEqual(self.flaw(NOW + (VALIDITY - RENEWAL_MARGIN).total_seconds() - 3 * DAY), "")
        self.assertEqual(self.flaw(NOW + (VALIDITY - RENEWAL_MARGIN).total_seconds()), "the certificate expires soon")
        self.assertEqual(self.flaw(NOW - 3 * DAY), "the certificate is not valid yet")
        lasts = self.leaf.certificate.not_valid_after_utc - self.leaf.certificate.not_valid_before_utc
        self.assertEqual(lasts, timedelta(days=365))

    def test_name_what_it_lacks(self) -> None:
        """A certificate that lacks an address of the node has a flaw.

        A missing name that the authority cannot sign is no flaw.
        """
        self.assertEqual(self.flaw(names=["192.168.0.8"]), "the certificate lacks 192.168.0.8")
        self.assertEqual(self.flaw(names=["8.8.8.8", "example.org", "fe80::1%eth0", "", "a b.local", "-"]), "")
        self.assertEqual(self.flaw(names=["::ffff:192.168.0.7", "VAIO.local.", "127.0.0.1", "localhost"]), "")

    def test_tell_a_foreign_one(self) -> None:
        """A certificate of a different authority is rejected, and so is a private key that does not match."""
        self.assertIn("another authority", self.leaf.find_flaw(make_authority(bytes(32), "vaio"), self.names, NOW))
        other = make_leaf(self.signer, "vaio", self.names, NOW, random.Random(2))
        self.assertIn("key", Leaf(other.key, self.leaf.certificate).find_flaw(self.signer, self.names, NOW))

    def test_bear_any_clock(self) -> None:
        """With a clock that is wrong by decades a valid certificate is created.

        It is replaced when the clock is set.
        """
        for now in (0.0, -1e12, 9e9, 1e300):
            made = make_leaf(self.signer, "pi", [], now, random.Random(1))
            self.assertLess(made.certificate.not_valid_before_utc, made.certificate.not_valid_after_utc)
            self.assertNotEqual(made.find_flaw(self.signer, [], NOW), "")

    def test_read_what_was_kept(self) -> None:
        """A stored certificate is read again; truncated, empty, binary and unrelated PEM data are rejected."""
        again = parse_leaf(self.leaf.pem_with_key)
        self.assertEqual((again.names, again.pem_with_key), (self.leaf.names, self.leaf.pem_with_key))
        key = rsa.generate_private_key(65537, 2048)
        foreign = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        certificate = self.leaf.certificate.public_bytes(Encoding.PEM)
        for pem in (
            b"",
            b"\xff\x00" * 50,
            self.leaf.pem_with_key[:-40],
            self.leaf.pem_with_key[:200],
            certificate,
            foreign + certificate,
        ):
            self.assertRaises(ValueError, parse_leaf, pem)


def forged(signer: Authority, name: str) -> Leaf:
    """Return a certificate that an attacker with the secret would sign for an arbitrary name."""
    made = make_leaf(signer, "vaio", [], NOW, random.Random(1))
    try:
        wanted: Any = x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        wanted = x509.DNSName(name)
    builder = x509.CertificateBuilder(
        signer.certificate.subject,
        made.certificate.subject,
        made.key.public_key(),
        7,
        made.certificate.not_valid_before_utc,
        made.certificate.not_valid_after_utc,
    )
    for extension in made.certificate.extensions:
        is_names = isinstance(extension.value, x509.SubjectAlternativeName)
        value = x509.SubjectAlternativeName([wanted]) if is_names else extension.value
        builder = builder.add_extension(value, extension.critical)
    return Leaf(made.key, builder.sign(signer.key, SHA256()))
