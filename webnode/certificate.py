"""Create the certificate authority of a web node and the TLS certificates that it signs.  Pure.

Each web node derives its authority from random bytes in its store, so the authority is the same after each start and
no other member of the team can derive it.  Name constraints limit it to addresses and names of a local network: a web
node cannot impersonate an internet site to phones that trust its authority.
"""

from __future__ import annotations

import hashlib
import ipaddress
import random
from collections.abc import Collection
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

HASH_PERSON = b"swarm-page-tls"
CURVE_ORDER = 0xFFFFFFFF00000000FFFFFFFFFFFFFFFFBCE6FAADA7179E84F3B9CAC2FC632551
"""Order of the group of P-256; a private key is a number below it."""
FROM, UNTIL = datetime(2025, 1, 1, tzinfo=UTC), datetime(2049, 12, 31, tzinfo=UTC)
"""Validity of the authority; constant, so the certificate is the same after each start, whatever the clock shows."""
VALIDITY = timedelta(days=365)
"""Validity of a node's certificate; phones reject certificates that are valid for more than 825 days."""
CLOCK_TOLERANCE = timedelta(days=2)
"""A node's certificate is valid from this long before its creation, to tolerate clock differences."""
RENEWAL_MARGIN = timedelta(days=30)
"""A certificate with less remaining validity is replaced."""
NETWORKS = (
    *("10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "100.64.0.0/10", "169.254.0.0/16", "127.0.0.0/8"),
    *("fc00::/7", "fe80::/10", "::1/128"),
)
DOMAINS = ("localhost", "local", "lan", "internal", "home.arpa")
MAX_NAMES = 32
"""Maximum number of names in one certificate."""


@dataclass(frozen=True)
class Credential:
    """A private key and its certificate."""

    key: ec.EllipticCurvePrivateKey
    certificate: x509.Certificate

    @property
    def pem(self) -> bytes:
        """The certificate in PEM; public."""
        return bytes(self.certificate.public_bytes(Encoding.PEM))


class Authority(Credential):
    """The key and certificate that sign for a web node."""

    @property
    def fingerprint(self) -> str:
        """The SHA-256 hash of the certificate as phones show it, for comparison by a person."""
        return bytes(self.certificate.fingerprint(SHA256())).hex(":").upper()


def make_authority(secret: bytes, title: str) -> Authority:
    """Return the authority of the node with the secret ``secret`` and the display name ``title``."""
    key = _derive_key(secret, b"authority")
    # A phone lists authorities by name, so names of different nodes must differ.
    mark = hashlib.blake2s(_encode_point(key), digest_size=3).hexdigest()
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"Swarm {title} {mark}")])
    constraints = x509.NameConstraints(
        [
            *(x509.DNSName(domain) for domain in DOMAINS),
            *(x509.IPAddress(ipaddress.ip_network(network)) for network in NETWORKS),
        ],
        None,
    )
    builder = (
        _start_builder(
            name, name, key, int.from_bytes(hashlib.blake2b(_encode_point(key), digest_size=15).digest()), FROM, UNTIL
        )
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_make_usage(signs_certificates=True), critical=True)
        .add_extension(constraints, critical=True)
    )
    return Authority(key, builder.sign(key, SHA256(), ecdsa_deterministic=True))


class Leaf(Credential):
    """A node's own certificate and its key."""

    @property
    def pem_with_key(self) -> bytes:
        """The certificate and its private key in PEM; secret."""
        return bytes(self.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())) + self.pem

    def find_flaw(self, signer: Authority, names: Collection[str], now: float) -> str:
        """Return why the certificate cannot serve ``names`` at the unix time ``now``; empty if it can."""
        certificate, moment = self.certificate, _to_datetime(now)
        if _encode_point(self.key) != certificate.public_key().public_bytes(
            Encoding.X962, PublicFormat.UncompressedPoint
        ):
            return "the certificate does not belong to its private key"
        try:
            certificate.verify_directly_issued_by(signer.certificate)
        except (InvalidSignature, ValueError, TypeError):
            return "another authority signed the certificate"
        if moment < certificate.not_valid_before_utc:
            return "the certificate is not valid yet"
        if moment > certificate.not_valid_after_utc - RENEWAL_MARGIN:
            return "the certificate expires soon"
        missing = [name for name in filter_names(names) if name not in self.names]
        return f"the certificate lacks {', '.join(missing)}" if missing else ""

    @property
    def names(self) -> list[str]:
        """The addresses and names for which the certificate is valid."""
        try:
            found = self.certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        except x509.ExtensionNotFound:
            return []
        return [str(name.value) for name in found]


def parse_leaf(pem: bytes) -> Leaf:
    """Parse a leaf from its ``pem_with_key``; raises ``ValueError`` if that is invalid."""
    try:
        key = load_pem_private_key(pem, None)
        certificate = x509.load_pem_x509_certificate(pem)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise ValueError("the file does not contain a certificate and its private key") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey) or not isinstance(
        certificate.public_key(), ec.EllipticCurvePublicKey
    ):
        raise ValueError("the private key is not an elliptic curve key")
    return Leaf(key, certificate)


def make_leaf(signer: Authority, title: str, names: Collection[str], now: float, rng: random.Random) -> Leaf:
    """Sign a certificate for the node called ``title``, for the ``names`` that the authority may sign."""
    key = _derive_key(rng.randbytes(32), b"leaf")
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, title)])
    since = min(max(_to_datetime(now) - CLOCK_TOLERANCE, FROM), UNTIL - VALIDITY)
    serial = int.from_bytes(rng.randbytes(15)) or 1
    builder = (
        _start_builder(subject, signer.certificate.subject, key, serial, since, since + VALIDITY, signer)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_make_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .add_extension(
            x509.SubjectAlternativeName([_make_general_name(name) for name in filter_names(names)]), critical=False
        )
    )
    return Leaf(key, builder.sign(signer.key, SHA256(), ecdsa_deterministic=True))


def filter_names(names: Collection[str]) -> list[str]:
    """Return the ``names`` for which the authority may sign, in canonical form; includes localhost."""
    usual = (normalize_name(name) for name in ("localhost", "127.0.0.1", "::1", *names))
    return list(dict.fromkeys(name for name in usual if name))[:MAX_NAMES]


def normalize_name(name: str) -> str:
    """Return the canonical form of an address or name; empty if the authority must not sign for it."""
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        lower = name.rstrip(".").lower()
        labels = lower.split(".")
        is_valid = all(0 < len(label) < 64 and label.replace("-", "").isalnum() for label in labels)
        is_hostname = is_valid and lower.isascii() and len(lower) < 254
        return lower if is_hostname and any(lower == end or lower.endswith(f".{end}") for end in DOMAINS) else ""
    if isinstance(address, ipaddress.IPv6Address):
        address = address.ipv4_mapped or address
    # A zone such as fe80::1%eth0 is valid on one machine only.
    fits = any(address in ipaddress.ip_network(network) for network in NETWORKS) and "%" not in str(address)
    return str(address) if fits else ""


def _make_general_name(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)


def _derive_key(secret: bytes, use: bytes) -> ec.EllipticCurvePrivateKey:
    """Derive a private key from a secret; the hash of 64 bytes keeps the distribution of keys uniform."""
    number = int.from_bytes(hashlib.blake2b(secret, digest_size=64, key=use, person=HASH_PERSON).digest())
    return ec.derive_private_key(1 + number % (CURVE_ORDER - 1), ec.SECP256R1())


def _encode_point(key: ec.EllipticCurvePrivateKey) -> bytes:
    return bytes(key.public_key().public_bytes(Encoding.X962, PublicFormat.UncompressedPoint))


def _to_datetime(now: float) -> datetime:
    """Convert unix time to a datetime, clamped to the validity of the authority."""
    try:
        return min(max(datetime.fromtimestamp(now, UTC), FROM), UNTIL)
    except (ValueError, OverflowError, OSError):
        return FROM


def _start_builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    serial: int,
    since: datetime,
    until: datetime,
    signer: Authority | None = None,
) -> x509.CertificateBuilder:
    public = key.public_key()
    signing = public if signer is None else signer.key.public_key()
    return (
        x509.CertificateBuilder(issuer, subject, public, serial)
        .not_valid_before(since.replace(microsecond=0))
        .not_valid_after(until.replace(microsecond=0))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signing), critical=False)
    )


def _make_usage(signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )
