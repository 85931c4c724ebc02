"""Terms of an invitation: what a newcomer believes because it has the code, and for no other reason.

A newcomer does not know the operator's key, and a node that answers it may be a hostile member, which knows the
invitation's public key and the team's secrets.  So the operator seals its own public key, the team's name and the
settings of newcomers under a key that only the code yields (XChaCha20-Poly1305).  The sealed terms travel with the
membership list; no member can read them, and none can make others.

A password-authenticated key exchange, as in magic-wormhole, would need the operator's side to be there when a newcomer
joins, whereas here the operator's key lies on no node.  Members can search the code offline, therefore it has 75 bits.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass, field

import msgpack
from nacl import bindings
from nacl.exceptions import CryptoError

from middleware.admission.code import Code
from middleware.admission.statement import MAX_TERMS, named, sized
from middleware.entangled.errors import Forged, Malformed

MAX_SETTINGS = 16
_NONCE = 24
_ABOUT = b"swarm-terms-1"


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
