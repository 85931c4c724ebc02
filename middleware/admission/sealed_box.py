"""Encryption to one X25519 key and a shared secret, with an ephemeral sender key."""

from __future__ import annotations

import hashlib
import random

from nacl import bindings
from nacl.exceptions import CryptoError

from middleware.entangled.errors import Forged

KEY_BYTES = 32
OVERHEAD_BYTES = KEY_BYTES + 16
_NONCE = bytes(12)
"""The nonce is constant, because each message has a new key."""


def seal(message: bytes, to: bytes, shared: bytes, about: bytes, rng: random.Random) -> bytes:
    """Encrypt ``message`` to the X25519 key ``to`` and the secret ``shared``; ``about`` is authenticated with it.

    The result is ``OVERHEAD_BYTES`` bytes longer.  Raises ``Forged`` if ``to`` is not a valid key.
    """
    secret = rng.randbytes(KEY_BYTES)
    public = bindings.crypto_scalarmult_base(secret)
    key = _derive_key(secret, to, public, to, shared)
    return public + bindings.crypto_aead_chacha20poly1305_ietf_encrypt(message, about, _NONCE, key)


def unseal(whole: bytes, secret: bytes, shared: bytes, about: bytes) -> bytes:
    """Decrypt a message with the X25519 secret key ``secret``; raises ``Forged``."""
    if len(whole) < OVERHEAD_BYTES:
        raise Forged("the encrypted message is too short")
    public = whole[:KEY_BYTES]
    key = _derive_key(secret, public, public, bindings.crypto_scalarmult_base(secret), shared)
    try:
        return bindings.crypto_aead_chacha20poly1305_ietf_decrypt(whole[KEY_BYTES:], about, _NONCE, key)
    except (CryptoError, ValueError) as error:
        raise Forged("the message cannot be decrypted") from error


def _derive_key(secret: bytes, public: bytes, sender: bytes, receiver: bytes, shared: bytes) -> bytes:
    try:
        agreed = bindings.crypto_scalarmult(secret, public)
    except (CryptoError, RuntimeError, ValueError, TypeError) as error:
        raise Forged("the key is not a valid X25519 key") from error
    return hashlib.blake2s(agreed + sender + receiver, key=shared, person=b"sealed").digest()
