"""Sealed: a message that only the holder of one X25519 key can open, and only with what both know beside it."""

from __future__ import annotations

import hashlib
import random

from nacl import bindings
from nacl.exceptions import CryptoError

from middleware.entangled.errors import Forged

KEY = 32
OVERHEAD = KEY + 16
_NONCE = bytes(12)
"""Each message has a key of its own."""


def sealed(message: bytes, to: bytes, shared: bytes, about: bytes, rng: random.Random) -> bytes:
    """``message`` for the holder of the X25519 key ``to`` who knows ``shared``; ``about`` is authenticated with it.

    It is ``OVERHEAD`` bytes longer.  Raises ``Forged`` where ``to`` is no key.
    """
    secret = rng.randbytes(KEY)
    public = bindings.crypto_scalarmult_base(secret)
    key = _key(secret, to, public, to, shared)
    return public + bindings.crypto_aead_chacha20poly1305_ietf_encrypt(message, about, _NONCE, key)


def opened(whole: bytes, secret: bytes, shared: bytes, about: bytes) -> bytes:
    """What was sealed for the X25519 secret ``secret``; raises ``Forged``."""
    if len(whole) < OVERHEAD:
        raise Forged("a sealed message that is too short")
    public = whole[:KEY]
    key = _key(secret, public, public, bindings.crypto_scalarmult_base(secret), shared)
    try:
        return bindings.crypto_aead_chacha20poly1305_ietf_decrypt(whole[KEY:], about, _NONCE, key)
    except (CryptoError, ValueError) as error:
        raise Forged("a sealed message that does not open") from error


def _key(secret: bytes, public: bytes, sender: bytes, receiver: bytes, shared: bytes) -> bytes:
    try:
        agreed = bindings.crypto_scalarmult(secret, public)
    except (CryptoError, RuntimeError, ValueError, TypeError) as error:
        raise Forged("not an X25519 key") from error
    return hashlib.blake2s(agreed + sender + receiver, key=shared, person=b"sealed").digest()
