"""Derive a node's key pairs and its node id from a seed.

One 32-byte seed determines the Ed25519 key pair that signs records and the X25519 key pair that opens sessions.  The
node id is the hash of the public key, so a node can neither choose its id nor use the id of another node.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import lru_cache

from nacl import bindings
from nacl.exceptions import CryptoError

ID_BYTES = 20


@dataclass(frozen=True)
class Identity:
    """A node's key pairs, derived from a secret ``seed`` of 32 bytes."""

    seed: bytes = field(repr=False)
    public: bytes = field(init=False)
    node_id: bytes = field(init=False)
    exchange_secret: bytes = field(init=False, repr=False)
    _signing: bytes = field(init=False, repr=False)

    def __post_init__(self) -> None:
        public, signing = bindings.crypto_sign_seed_keypair(self.seed)
        object.__setattr__(self, "public", public)
        object.__setattr__(self, "_signing", signing)
        object.__setattr__(self, "node_id", derive_node_id(public))
        object.__setattr__(self, "exchange_secret", bindings.crypto_sign_ed25519_sk_to_curve25519(signing))

    def sign(self, message: bytes) -> bytes:
        """Return the 64-byte Ed25519 signature of ``message``."""
        return bindings.crypto_sign(message, self._signing)[: bindings.crypto_sign_BYTES]


def derive_node_id(public: bytes) -> bytes:
    """Return the 160-bit id of the node with the key ``public``."""
    return hashlib.blake2s(public, digest_size=ID_BYTES).digest()


@lru_cache(maxsize=128)  # a handshake needs two conversions, each as expensive as a key exchange
def derive_exchange_key(public: bytes) -> bytes:
    """Convert an Ed25519 public key to its X25519 key; raise ``ValueError`` if the key is invalid."""
    try:
        return bindings.crypto_sign_ed25519_pk_to_curve25519(public)
    except CryptoError as error:
        raise ValueError("the key is not an Ed25519 public key") from error


def is_signature_valid(public: bytes, message: bytes, signature: bytes) -> bool:
    """Return whether ``signature`` over ``message`` was made with the key of ``public``."""
    try:
        bindings.crypto_sign_open(signature + message, public)
    except (CryptoError, ValueError):
        return False
    return True
