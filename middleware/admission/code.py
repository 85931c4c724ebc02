"""Code: what an operator reads out and a newcomer types, 20 characters that stand for the key of an invitation.

75 bits are the secret, 20 the fingerprint of the operator's public key, and 5 a check over both.  Two keys follow from
them: that of the invitation, whose public half every member knows, and that of its terms, which only the operator and
the newcomer can make.  The letters are those of Crockford's base 32: no I, L, O and U, and what looks like one of these
is read as the digit.  The check is a sum over GF(32) with another weight for each place, so every single wrong
character, and every two that changed places, is noticed before anything is sent.

A newcomer does not know the operator's key, and a node that answers it may be a hostile member, which knows the
invitation's public key and the team's secrets.  So the operator seals its own public key, the team's name and the
settings of newcomers under a key that only the code yields (XChaCha20-Poly1305).  The sealed terms travel with the
membership list; no member can read them, and none can make others.

A password-authenticated key exchange, as in magic-wormhole, would need the operator's side to be there when a newcomer
joins, whereas here the operator's key lies on no node.  Members can search the code offline, therefore it has 75 bits.
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
from middleware.admission.statement import MAX_TERMS, named, sized
from middleware.entangled.errors import Forged, Malformed
from middleware.entangled.identity import Identity

LETTERS = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"
ALIKE = str.maketrans("OIL", "011", " -\t\r\n")
LENGTH, GROUP = 20, 5
_SECRET, _MARK = 15, 4
_SECRET_BITS, _MARK_BITS = 5 * _SECRET, 5 * _MARK
_FIELD = 0b100101
"""x^5 + x^2 + 1, which is primitive, so that the powers of x are all elements of the field but 0."""
MAX_SETTINGS = 16
_NONCE = 24
_ABOUT = b"swarm-terms-1"


@dataclass(frozen=True)
class Code:
    """An invitation as a person sees it: its ``secret`` (75 bits) and the ``mark`` of the operator (20 bits)."""

    secret: int = field(repr=False)
    mark: int

    @property
    def text(self) -> str:
        """Four groups of five characters."""
        letters = _letters(self.secret, _SECRET) + _letters(self.mark, _MARK)
        letters += LETTERS[_check([LETTERS.index(letter) for letter in letters])]
        return "-".join(letters[start : start + GROUP] for start in range(0, LENGTH, GROUP))

    @property
    def key(self) -> Identity:
        """The key pair of the invitation, which whoever has the code can make."""
        content = self.secret.to_bytes(10) + self.mark.to_bytes(3)
        return Identity(hashlib.blake2s(content, person=b"code").digest())

    @property
    def terms_key(self) -> bytes:
        """The 32 bytes under which the operator seals the terms of the invitation.

        They cannot be computed from the public key of the invitation but by trying all 2**75 secrets.
        """
        content = self.secret.to_bytes(10) + self.mark.to_bytes(3)
        return hashlib.blake2s(content, person=b"terms").digest()

    def fits(self, operator: bytes) -> bool:
        """Whether the code can come from the operator with that public key."""
        return mark_of(operator) == self.mark


def mark_of(operator: bytes) -> int:
    """The 20 bits of an operator's public key that stand in each of its codes."""
    return int.from_bytes(hashlib.blake2s(operator, digest_size=4, person=b"mark").digest()) >> (32 - _MARK_BITS)


def drawn(operator: bytes, rng: random.Random) -> Code:
    """A new code of the operator with that public key."""
    return Code(rng.getrandbits(_SECRET_BITS), mark_of(operator))


def read(text: str) -> Code:
    """The code that a person typed, in groups or not, in capitals or not; raises ``BadCode``."""
    letters = text.upper().translate(ALIKE)
    wrong = next((letter for letter in letters if letter not in LETTERS), "")
    if wrong:
        raise BadCode(f"{wrong!r} stands in no code; a code has digits and letters but U; read it again")
    if len(letters) != LENGTH:
        raise BadCode(f"a code has {LENGTH} characters, this one has {len(letters)}; read it again")
    places = [LETTERS.index(letter) for letter in letters]
    if _check(places[:-1]) != places[-1]:
        raise BadCode("the code is mistyped: its last character does not fit the others; read it again")
    return Code(_number(places[:_SECRET]), _number(places[_SECRET:-1]))


@dataclass(frozen=True)
class TermsContent:
    """The operator's public key, the team's name, and the settings that newcomers get."""

    operator: bytes
    team: str
    settings: Mapping[str, str | int | float | bool] = field(default_factory=dict)


def seal_terms(code: Code, content: TermsContent, rng: random.Random) -> bytes:
    """Seal ``content`` for whoever has ``code``; raises ``ValueError`` where it is too long."""
    body = msgpack.packb([content.operator, content.team, dict(content.settings)])
    nonce = rng.randbytes(_NONCE)
    sealed: bytes = nonce + bindings.crypto_aead_xchacha20poly1305_ietf_encrypt(body, _ABOUT, nonce, code.terms_key)
    if len(sealed) > MAX_TERMS or len(content.settings) > MAX_SETTINGS:
        raise ValueError(f"the settings of newcomers take {len(sealed)} bytes, at most {MAX_TERMS}; share fewer")
    return sealed


def open_terms(code: Code, sealed: bytes) -> TermsContent:
    """Open what the operator sealed for ``code``; raises ``Forged`` or ``Malformed``."""
    try:
        body = bindings.crypto_aead_xchacha20poly1305_ietf_decrypt(
            sealed[_NONCE:], _ABOUT, sealed[:_NONCE], code.terms_key
        )
    except (CryptoError, ValueError) as error:
        raise Forged("terms that this code does not open") from error
    try:
        operator, team, settings = msgpack.unpackb(body, max_map_len=MAX_SETTINGS, max_ext_len=0, max_array_len=3)
        if not all(isinstance(k, str) and isinstance(v, str | int | float | bool) for k, v in settings.items()):
            raise Malformed("settings of other types than they should have")
        content = TermsContent(sized(operator, 32), named(team), settings)
    except Malformed:
        raise
    except Exception as error:  # the one place where these bytes are unpacked
        raise Malformed("terms with other fields than they should have") from error
    if not code.fits(content.operator):
        raise Forged("terms of another operator than the code names")
    return content


def _letters(number: int, count: int) -> str:
    return "".join(LETTERS[number >> 5 * place & 31] for place in reversed(range(count)))


def _number(places: list[int]) -> int:
    number = 0
    for place in places:
        number = number << 5 | place
    return number


def _check(places: list[int]) -> int:
    """The sum of the places, each times its own power of x; the check itself has the weight 1."""
    total = 0
    for place in places:
        total = _doubled(total ^ place)
    return total


def _doubled(element: int) -> int:
    doubled = element << 1
    return doubled ^ _FIELD if doubled & 32 else doubled
