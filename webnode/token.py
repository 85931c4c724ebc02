"""Sign and verify session tokens, each issued by a web node for one web node.  Pure.

A web node signs with the identity of its node: an Ed25519 key, which has the role ``gateway`` from the operator of a
closed team.  So members without that role cannot issue valid tokens, and a secret that all members share is not enough
to issue a token.  Signing and encoding use ``itsdangerous``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import msgpack
from itsdangerous import BadData, Signer
from itsdangerous.encoding import base64_decode, base64_encode
from itsdangerous.signer import SigningAlgorithm

from middleware.entangled.identity import Identity, is_signature_valid
from webnode.auth import Role

ROLES: tuple[Role, ...] = ("viewer", "operator", "phone")
VERSION = 3
SESSION_BYTES = 8
MAX_NAME = 64
MAX_VOUCHERS = 3
"""Maximum number of other web nodes through which a session may have come."""
MAX_PARENTS = 3
MAX_TEXT = 700
MAX_CACHED = 512
"""Number of verified tokens cached; a verification takes 80 us, and streams are checked every second."""
MAX_TIME_S = 2**40
SIGNATURE_DOMAIN = b"swarm-page-1 "


@dataclass(frozen=True)
class Claim:
    """The content of a token.

    ``id`` names the session, ``parents`` the sessions or invitations from which it is derived and with which it ends.
    ``until`` is the expiry, ``limit`` the latest expiry of a renewed token, both in whole unix seconds.  ``is_ticket``
    is whether the token is for the query of a GET.  ``vouchers`` are the public keys of the web nodes that vouch for
    it.
    """

    id: str
    name: str
    role: Role
    until: int
    is_ticket: bool = False
    limit: int = 0
    parents: tuple[str, ...] = ()
    vouchers: tuple[bytes, ...] = ()

    @property
    def ticket(self) -> Claim:
        """A claim of the same session that can only read, because URLs leak more easily than headers."""
        return replace(self, role="phone" if self.role == "phone" else "viewer", is_ticket=True)


class Ed25519(SigningAlgorithm):
    """Ed25519 signatures by ``identity``; without one, signatures can only be verified."""

    def __init__(self, identity: Identity | None = None) -> None:
        self._identity = identity

    def get_signature(self, key: bytes, value: bytes) -> bytes:
        """Return the signature of ``value``; ``key`` is the public key of the identity."""
        assert self._identity is not None and key == self._identity.public
        return self._identity.sign(SIGNATURE_DOMAIN + value)

    def verify_signature(self, key: bytes, value: bytes, sig: bytes) -> bool:
        """Return whether the owner of the public key ``key`` signed ``value``."""
        return is_signature_valid(key, SIGNATURE_DOMAIN + value, sig)


class TokenKey:
    """The key with which one web node signs its tokens and verifies tokens for it."""

    def __init__(self, identity: Identity) -> None:
        self.public = identity.public
        self.node_id = identity.node_id
        self._signer = _make_signer(identity.public, Ed25519(identity))
        self._read = lru_cache(MAX_CACHED)(self._verify)

    def sign_token(self, claim: Claim, audience: bytes = b"") -> str:
        """Return the token of ``claim`` for the node with the id ``audience``, by default for this one.

        It consists of letters, digits, ``-``, ``_`` and ``.``.  A token for this node has no audience.
        """
        is_own = audience in (b"", self.node_id)
        value = base64_encode(encode_claim(claim, b"" if is_own else audience))
        return self._signer.sign(value if is_own else base64_encode(self.public) + b"." + value).decode()

    def read_claim(self, text: str) -> Claim | None:
        """Return the content of a token for this node, with its signer among the vouchers; None if it is invalid.

        The caller checks the expiry and whether the vouchers may vouch.
        """
        return self._read(text) if 0 < len(text) <= MAX_TEXT and text.isascii() else None

    def _verify(self, text: str) -> Claim | None:
        issuer, _, value = text.rpartition(".")[0].rpartition(".")
        is_own = not issuer
        try:
            public = self.public if is_own else base64_decode(issuer)
            if len(public) != len(self.public):
                return None
            _make_signer(public, Ed25519()).unsign(text)
            return decode_claim(base64_decode(value), public, b"" if is_own else self.node_id)
        except (BadData, ValueError, TypeError):
            return None


def _make_signer(public: bytes, algorithm: Ed25519) -> Signer:
    # No key derivation: the algorithm is asymmetric, and the key identifies the signer.
    return Signer(public, key_derivation="none", algorithm=algorithm)


def encode_claim(claim: Claim, audience: bytes = b"") -> bytes:
    """Encode a claim."""
    flags = ROLES.index(claim.role) << 1 | claim.is_ticket
    vouchers = list(claim.vouchers)
    parents = [bytes.fromhex(each) for each in claim.parents]
    fields = [VERSION, flags, claim.until, claim.limit, bytes.fromhex(claim.id), claim.name[:MAX_NAME]]
    return bytes(msgpack.packb([*fields, parents, vouchers, audience]))


def decode_claim(data: bytes, issuer: bytes, audience: bytes) -> Claim:
    """Decode the claim in ``data``, signed by ``issuer``; raises ``ValueError`` if it is not valid for ``audience``."""
    fields = msgpack.unpackb(data)
    version, flags, until, limit, session, name, parents, vouchers, meant = fields
    is_lawful = (
        version == VERSION
        and type(flags) is int
        and 0 <= flags < 2 * len(ROLES)
        and all(type(each) is int and 0 <= each < MAX_TIME_S for each in (until, limit))
        and isinstance(name, str)
        and isinstance(parents, list)
        and isinstance(vouchers, list)
        and meant == audience
        and all(isinstance(each, bytes) and len(each) == SESSION_BYTES for each in (session, *parents))
        and all(isinstance(each, bytes) and len(each) == len(issuer) for each in vouchers)
        and len(parents) <= MAX_PARENTS
        and len(vouchers) <= MAX_VOUCHERS
    )
    if not is_lawful:
        raise ValueError("invalid token for this node")
    lineage = tuple(each.hex() for each in parents)
    through = tuple(dict.fromkeys((*vouchers, issuer)))
    return Claim(session.hex(), name, ROLES[flags >> 1], until, bool(flags & 1), limit, lineage, through)
