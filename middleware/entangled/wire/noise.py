"""Implement the handshake pattern ``IK`` of the Noise Protocol Framework, with and without a pre-shared key.

The protocols are ``Noise_IK_25519_ChaChaPoly_BLAKE2s`` and ``Noise_IKpsk1_25519_ChaChaPoly_BLAKE2s`` after the
specification (noiseprotocol.org, revision 34; the section numbers below refer to it).  The pre-shared key is mixed in
at the end of the first message's tokens, so a node without it cannot decrypt even the first payload.
"""

from __future__ import annotations

import copy
import hashlib
from typing import NamedTuple, Self

from nacl import bindings
from nacl._sodium import ffi, lib  # type: ignore[import-not-found]
from nacl.exceptions import CryptoError

from middleware.entangled.errors import Forged

KEY_BYTES = 32
TAG_BYTES = 16
FIRST_OVERHEAD_BYTES = KEY_BYTES + KEY_BYTES + TAG_BYTES + TAG_BYTES
SECOND_OVERHEAD_BYTES = KEY_BYTES + TAG_BYTES
_ZERO4 = bytes(4)
_BLOCK = 64
_INNER = bytes(byte ^ 0x36 for byte in range(256))
_OUTER = bytes(byte ^ 0x5C for byte in range(256))

_NULL, _new, _buffer = ffi.NULL, ffi.new, ffi.buffer
_BYTES = ffi.typeof("unsigned char[]")
_encrypt = lib.crypto_aead_chacha20poly1305_ietf_encrypt
_decrypt = lib.crypto_aead_chacha20poly1305_ietf_decrypt


class KeyPair(NamedTuple):
    """An X25519 key pair."""

    secret: bytes
    public: bytes


def make_key_pair(secret: bytes) -> KeyPair:
    """Return the key pair of 32 secret bytes."""
    return KeyPair(secret, bindings.crypto_scalarmult_base(secret))


class TransportKeys(NamedTuple):
    """The result of a handshake: a key for each direction (32 bytes), and the hash of the transcript."""

    sending: bytes
    receiving: bytes
    handshake_hash: bytes


def seal(key: bytes, counter: int, plaintext: bytes, ad: bytes) -> bytes:
    """Encrypt ``plaintext`` with ChaCha20-Poly1305 and Noise's nonce (section 12); the result is 16 bytes longer.

    This function calls libsodium directly, because the argument checks of PyNaCl's wrapper take three quarters of the
    time.  The check of the key length is sufficient for memory safety.
    """
    if len(key) != KEY_BYTES:
        raise ValueError(f"a key must have {KEY_BYTES} bytes, not {len(key)}")
    size = len(plaintext) + TAG_BYTES
    out = _new(_BYTES, size)
    nonce = _ZERO4 + counter.to_bytes(8, "little")
    _encrypt(out, _NULL, plaintext, len(plaintext), ad, len(ad), _NULL, nonce, key)
    result: bytes = _buffer(out, size)[:]
    return result


def open_sealed(key: bytes, counter: int, ciphertext: bytes, ad: bytes) -> bytes:
    """Decrypt the result of ``seal``; raise ``Forged`` if the ciphertext, key, counter or ``ad`` differs."""
    if len(key) != KEY_BYTES:
        raise ValueError(f"a key must have {KEY_BYTES} bytes, not {len(key)}")
    size = len(ciphertext) - TAG_BYTES
    if size < 0:
        raise Forged("the ciphertext is too short")
    out = _new(_BYTES, size or 1)
    nonce = _ZERO4 + counter.to_bytes(8, "little")
    if _decrypt(out, _NULL, _NULL, ciphertext, len(ciphertext), ad, len(ad), nonce, key):
        raise Forged("the ciphertext is not authentic")
    result: bytes = _buffer(out, size)[:]
    return result


def _exchange(secret: bytes, public: bytes) -> bytes:
    try:
        return bindings.crypto_scalarmult(secret, public)
    except (CryptoError, RuntimeError) as error:  # a key of small order makes the secret predictable
        raise Forged("the public key has a small order") from error


def _derive(chaining_key: bytes, material: bytes, count: int) -> list[bytes]:
    """Derive ``count`` outputs of 32 bytes (section 4.3)."""
    secret = _hmac(chaining_key, material)
    outputs = [_hmac(secret, b"\x01")]
    for number in range(2, count + 1):
        outputs.append(_hmac(secret, outputs[-1] + bytes([number])))
    return outputs


def _hmac(key: bytes, data: bytes) -> bytes:
    """Compute HMAC (RFC 2104) with BLAKE2s, in half the time of the ``hmac`` module; a handshake needs fifty HMACs."""
    padded = key.ljust(_BLOCK, b"\0")
    inner = hashlib.blake2s(padded.translate(_INNER) + data).digest()
    return hashlib.blake2s(padded.translate(_OUTER) + inner).digest()


class _Transcript:
    """The symmetric state of section 5.2."""

    def __init__(self, name: bytes, prologue: bytes) -> None:
        self.hash = name.ljust(32, b"\0") if len(name) <= 32 else hashlib.blake2s(name).digest()
        self.chaining_key = self.hash
        self.key = b""
        self.counter = 0
        self.mix_hash(prologue)

    def mix_hash(self, data: bytes) -> None:
        self.hash = hashlib.blake2s(self.hash + data).digest()

    def mix_key(self, material: bytes) -> None:
        self.chaining_key, self.key = _derive(self.chaining_key, material, 2)
        self.counter = 0

    def mix_key_and_hash(self, material: bytes) -> None:
        self.chaining_key, hashed, self.key = _derive(self.chaining_key, material, 3)
        self.mix_hash(hashed)
        self.counter = 0

    def seal(self, plaintext: bytes) -> bytes:
        ciphertext = seal(self.key, self.counter, plaintext, self.hash)
        self.counter += 1
        self.mix_hash(ciphertext)
        return ciphertext

    def open(self, ciphertext: bytes) -> bytes:
        plaintext = open_sealed(self.key, self.counter, ciphertext, self.hash)
        self.counter += 1
        self.mix_hash(ciphertext)
        return plaintext

    def split(self) -> tuple[bytes, bytes]:
        first, second = _derive(self.chaining_key, b"", 2)
        return first, second


class _Side:
    """The common part of both roles of ``IK``.

    ``psk`` is the pre-shared key of 32 bytes, or None for plain ``IK``.  The ephemeral secret is a parameter, so that
    runs are reproducible; it must never be used twice.
    """

    def __init__(self, static: KeyPair, ephemeral_secret: bytes, prologue: bytes, psk: bytes | None) -> None:
        modifier = b"" if psk is None else b"psk1"
        self._transcript = _Transcript(b"Noise_IK" + modifier + b"_25519_ChaChaPoly_BLAKE2s", prologue)
        self._static = static
        self._ephemeral_secret = ephemeral_secret
        self._psk = psk

    def copy(self) -> Self:
        """Return a copy of the handshake state, so that reading a forged message does not corrupt it."""
        twin = copy.copy(self)
        twin._transcript = copy.copy(self._transcript)
        return twin

    def _mix_ephemeral(self, public: bytes) -> None:
        self._transcript.mix_hash(public)
        if self._psk is not None:  # section 9.2: ephemeral keys randomise the encryption under the pre-shared key
            self._transcript.mix_key(public)

    def _mix_psk(self) -> None:
        if self._psk is not None:
            self._transcript.mix_key_and_hash(self._psk)


class Initiator(_Side):
    """The role that knows the responder's static key and sends the first message."""

    def __init__(
        self,
        static: KeyPair,
        remote_static: bytes,
        ephemeral_secret: bytes,
        prologue: bytes = b"",
        psk: bytes | None = None,
    ) -> None:
        super().__init__(static, ephemeral_secret, prologue, psk)
        self._remote_static = remote_static
        self._transcript.mix_hash(remote_static)

    def write(self, payload: bytes) -> bytes:
        """Return the first message (tokens e, es, s, ss and psk): 96 bytes longer than ``payload``."""
        ephemeral = make_key_pair(self._ephemeral_secret)
        transcript = self._transcript
        self._mix_ephemeral(ephemeral.public)
        transcript.mix_key(_exchange(ephemeral.secret, self._remote_static))
        static = transcript.seal(self._static.public)
        transcript.mix_key(_exchange(self._static.secret, self._remote_static))
        self._mix_psk()
        return ephemeral.public + static + transcript.seal(payload)

    def read(self, message: bytes) -> tuple[bytes, TransportKeys]:
        """Return the payload of the second message (tokens e, ee, se), and the keys; raise ``Forged``."""
        if len(message) < SECOND_OVERHEAD_BYTES:
            raise Forged("the second message is too short")
        transcript = self._transcript
        ephemeral = message[:KEY_BYTES]
        self._mix_ephemeral(ephemeral)
        transcript.mix_key(_exchange(self._ephemeral_secret, ephemeral))
        transcript.mix_key(_exchange(self._static.secret, ephemeral))
        payload = transcript.open(message[KEY_BYTES:])
        sending, receiving = transcript.split()
        return payload, TransportKeys(sending, receiving, transcript.hash)


class Responder(_Side):
    """The role that receives the first message."""

    def __init__(
        self, static: KeyPair, ephemeral_secret: bytes, prologue: bytes = b"", psk: bytes | None = None
    ) -> None:
        super().__init__(static, ephemeral_secret, prologue, psk)
        self._transcript.mix_hash(static.public)
        self._remote_static = b""
        self._remote_ephemeral = b""

    def read(self, message: bytes) -> tuple[bytes, bytes]:
        """Return the payload of the first message and the verified static key of its sender; raise ``Forged``."""
        if len(message) < FIRST_OVERHEAD_BYTES:
            raise Forged("the first message is too short")
        transcript = self._transcript
        self._remote_ephemeral = message[:KEY_BYTES]
        self._mix_ephemeral(self._remote_ephemeral)
        transcript.mix_key(_exchange(self._static.secret, self._remote_ephemeral))
        self._remote_static = transcript.open(message[KEY_BYTES : KEY_BYTES + KEY_BYTES + TAG_BYTES])
        transcript.mix_key(_exchange(self._static.secret, self._remote_static))
        self._mix_psk()
        return transcript.open(message[KEY_BYTES + KEY_BYTES + TAG_BYTES :]), self._remote_static

    def write(self, payload: bytes) -> tuple[bytes, TransportKeys]:
        """Return the second message, 48 bytes longer than ``payload``, and the keys."""
        ephemeral = make_key_pair(self._ephemeral_secret)
        transcript = self._transcript
        self._mix_ephemeral(ephemeral.public)
        transcript.mix_key(_exchange(ephemeral.secret, self._remote_ephemeral))
        transcript.mix_key(_exchange(ephemeral.secret, self._remote_static))
        message = ephemeral.public + transcript.seal(payload)
        receiving, sending = transcript.split()
        return message, TransportKeys(sending, receiving, transcript.hash)
