"""Create a private key and a self-signed certificate for TLS; they authenticate no node.

An Ed25519 certificate (RFC 8410) has so few fields that this module encodes it directly.  A node that serves tunnels
therefore needs neither the package ``cryptography`` nor a certificate file.
"""

from __future__ import annotations

import base64
import textwrap

from nacl import bindings

_ED25519 = bytes.fromhex("300506032b6570")
"""The AlgorithmIdentifier of 1.3.101.112, which has no parameters."""
_COMMON_NAME = bytes.fromhex("0603550403")
_SUBJECT_ALTERNATIVE = bytes.fromhex("0603551d11")
# The validity starts in the past, because the clock of a robot may be wrong; no node verifies the certificate.
_FROM, _UNTIL = b"20200101000000Z", b"20991231235959Z"


def make_certificate(seed: bytes, serial: bytes, name: str = "localhost") -> str:
    """Return key and certificate in PEM for the 32-byte ``seed``; ``serial`` has 1 to 19 bytes."""
    public, secret = bindings.crypto_sign_seed_keypair(seed)
    subject = _sequence(_der(0x31, _sequence(_COMMON_NAME, _der(0x0C, name.encode()))))
    names = _sequence(_der(0x82, name.encode()))
    body = _sequence(
        _der(0xA0, _der(0x02, b"\x02")),
        _der(0x02, b"\x01" + serial),
        _ED25519,
        subject,
        _sequence(_der(0x18, _FROM), _der(0x18, _UNTIL)),
        subject,
        _sequence(_ED25519, _der(0x03, b"\x00" + public)),
        _der(0xA3, _sequence(_sequence(_SUBJECT_ALTERNATIVE, _der(0x04, names)))),
    )
    signature = bindings.crypto_sign(body, secret)[:64]
    certificate = _sequence(body, _ED25519, _der(0x03, b"\x00" + signature))
    key = _sequence(_der(0x02, b"\x00"), _ED25519, _der(0x04, _der(0x04, seed)))
    return _pem("PRIVATE KEY", key) + _pem("CERTIFICATE", certificate)


def _sequence(*parts: bytes) -> bytes:
    return _der(0x30, *parts)


def _der(tag: int, *parts: bytes) -> bytes:
    content = b"".join(parts)
    size = len(content)
    if size < 128:
        return bytes([tag, size]) + content
    length = size.to_bytes((size.bit_length() + 7) // 8, "big")
    return bytes([tag, 0x80 | len(length)]) + length + content


def _pem(title: str, der: bytes) -> str:
    lines = "\n".join(textwrap.wrap(base64.b64encode(der).decode(), 64))
    return f"-----BEGIN {title}-----\n{lines}\n-----END {title}-----\n"
