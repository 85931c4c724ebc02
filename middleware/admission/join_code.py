"""Join codes: 20 characters that an operator reads out and a newcomer types.

A code contains a secret of 75 bits, 20 bits of the fingerprint of the operator's public key, and 5 check bits.  Two
keys are derived from it: the invitation's key pair, whose public half every member knows, and the key of the
invitation's terms, which only the operator and the newcomer can derive.  The alphabet is Crockford's base 32 without I,
L, O and U; I, L and O are read as the digits that they resemble.  The check is a weighted sum over GF(32) with a
different weight for each position: so it detects every single wrong character, and every transposition of two
characters, before anything is sent.

A newcomer does not know the operator's key, and the node that answers it can be a hostile member, which knows the
invitation's public key and the team's secrets.  Therefore the operator encrypts its public key, the team's name and the
settings for newcomers under a key that only the code yields (XChaCha20-Poly1305).  The encrypted terms are distributed
with the membership list; members can neither read nor forge them.

A password-authenticated key exchange, as in magic-wormhole, would need the operator's key online when a newcomer joins,
but here no node has this key.  Members can search for the code offline; therefore its secret has 75 bits.
"""

from __future__ import annotations

import hashlib
import random
from collections.abc import Mapping
from dataclasses import dataclass, field

import msgpack
from nacl import bindings
from nacl.exceptions import CryptoError

from middleware.admission.errors import BadCode
from middleware.admission.statement import MAX_TERMS_BYTES, check_bytes, check_name
from middleware.entangled.errors import Forged, Malformed
from middleware.entangled.identity import Identity

ALPHABET = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"
NORMALIZATION = str.maketrans("OIL", "011", " -\t\r\n")
CODE_LENGTH, GROUP_LENGTH = 20, 5
_SECRET_LETTERS, _FINGERPRINT_LETTERS = 15, 4
_SECRET_BITS, _FINGERPRINT_BITS = 5 * _SECRET_LETTERS, 5 * _FINGERPRINT_LETTERS
_POLYNOMIAL = 0b100101
"""x^5 + x^2 + 1, a primitive polynomial: the powers of x are all non-zero elements of the field."""
MAX_SETTINGS = 16
_NONCE_BYTES = 24
_ASSOCIATED_DATA = b"swarm-terms-1"


@dataclass(frozen=True)
class JoinCode:
    """A join code: its ``secret`` (75 bits) and the ``fingerprint`` of the operator (20 bits)."""

    secret: int = field(repr=False)
    fingerprint: int

    @property
    def text(self) -> str:
        """The code in four groups of five characters."""
        letters = _encode(self.secret, _SECRET_LETTERS) + _encode(self.fingerprint, _FINGERPRINT_LETTERS)
        letters += ALPHABET[_compute_check([ALPHABET.index(letter) for letter in letters])]
        return "-".join(letters[start : start + GROUP_LENGTH] for start in range(0, CODE_LENGTH, GROUP_LENGTH))

    @property
    def key(self) -> Identity:
        """The key pair of the invitation, derived from the code."""
        content = self.secret.to_bytes(10) + self.fingerprint.to_bytes(3)
        return Identity(hashlib.blake2s(content, person=b"code").digest())

    @property
    def terms_key(self) -> bytes:
        """The 32 bytes of the key under which the operator encrypts the invitation's terms.

        Deriving them from the invitation's public key takes a search over all 2**75 secrets.
        """
        content = self.secret.to_bytes(10) + self.fingerprint.to_bytes(3)
        return hashlib.blake2s(content, person=b"terms").digest()

    def matches_operator(self, operator: bytes) -> bool:
        """Return whether the code can belong to the operator with that public key."""
        return compute_fingerprint(operator) == self.fingerprint


def compute_fingerprint(operator: bytes) -> int:
    """Return the 20 bits of an operator's public key that each of its codes contains."""
    return int.from_bytes(hashlib.blake2s(operator, digest_size=4, person=b"mark").digest()) >> (32 - _FINGERPRINT_BITS)


def draw_code(operator: bytes, rng: random.Random) -> JoinCode:
    """Draw a new code for the operator with that public key."""
    return JoinCode(rng.getrandbits(_SECRET_BITS), compute_fingerprint(operator))


def parse_code(text: str) -> JoinCode:
    """Parse a typed code, with or without separators, in upper or lower case; raises ``BadCode``."""
    letters = text.upper().translate(NORMALIZATION)
    wrong = next((letter for letter in letters if letter not in ALPHABET), "")
    if wrong:
        raise BadCode(f"the code contains {wrong!r}; a code has only digits and letters except U; check the code")
    if len(letters) != CODE_LENGTH:
        raise BadCode(f"a code has {CODE_LENGTH} characters, this one has {len(letters)}; check the code")
    digits = [ALPHABET.index(letter) for letter in letters]
    if _compute_check(digits[:-1]) != digits[-1]:
        raise BadCode("the code is mistyped: its check character does not match; type it again")
    return JoinCode(_decode(digits[:_SECRET_LETTERS]), _decode(digits[_SECRET_LETTERS:-1]))


@dataclass(frozen=True)
class TermsContent:
    """The content of an invitation's terms: operator's public key, team name, settings for newcomers."""

    operator: bytes
    team: str
    settings: Mapping[str, str | int | float | bool] = field(default_factory=dict)


def seal_terms(code: JoinCode, content: TermsContent, rng: random.Random) -> bytes:
    """Encrypt ``content`` for the holder of ``code``; raises ``ValueError`` if it is too long."""
    body = msgpack.packb([content.operator, content.team, dict(content.settings)])
    nonce = rng.randbytes(_NONCE_BYTES)
    sealed: bytes = nonce + bindings.crypto_aead_xchacha20poly1305_ietf_encrypt(
        body, _ASSOCIATED_DATA, nonce, code.terms_key
    )
    if len(sealed) > MAX_TERMS_BYTES or len(content.settings) > MAX_SETTINGS:
        raise ValueError(
            f"the settings for newcomers take {len(sealed)} bytes, at most {MAX_TERMS_BYTES}; share fewer settings"
        )
    return sealed


def open_terms(code: JoinCode, sealed: bytes) -> TermsContent:
    """Decrypt the terms of ``code``; raises ``Forged`` or ``Malformed``."""
    try:
        body = bindings.crypto_aead_xchacha20poly1305_ietf_decrypt(
            sealed[_NONCE_BYTES:], _ASSOCIATED_DATA, sealed[:_NONCE_BYTES], code.terms_key
        )
    except (CryptoError, ValueError) as error:
        raise Forged("the terms cannot be decrypted with this code") from error
    try:
        operator, team, settings = msgpack.unpackb(body, max_map_len=MAX_SETTINGS, max_ext_len=0, max_array_len=3)
        if not all(isinstance(k, str) and isinstance(v, str | int | float | bool) for k, v in settings.items()):
            raise Malformed("the terms contain settings of invalid types")
        content = TermsContent(check_bytes(operator, 32), check_name(team), settings)
    except Malformed:
        raise
    except Exception as error:  # untrusted bytes
        raise Malformed("the terms have invalid fields") from error
    if not code.matches_operator(content.operator):
        raise Forged("the terms are from a different operator than the code")
    return content


def _encode(number: int, count: int) -> str:
    return "".join(ALPHABET[number >> 5 * digit & 31] for digit in reversed(range(count)))


def _decode(digits: list[int]) -> int:
    number = 0
    for digit in digits:
        number = number << 5 | digit
    return number


def _compute_check(digits: list[int]) -> int:
    """Return the weighted sum of the positions; each has its own power of x, the check itself the weight 1."""
    total = 0
    for digit in digits:
        total = _multiply_by_x(total ^ digit)
    return total


def _multiply_by_x(element: int) -> int:
    product = element << 1
    return product ^ _POLYNOMIAL if product & 32 else product
