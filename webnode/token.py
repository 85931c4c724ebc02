"""Token: what a visitor of the page shows, signed by the web node that gave it, for one web node.  Pure.

A web node signs with the identity of its node: an Ed25519 key of its own, to which the operator of a closed team gives
the role ``gateway``.  So no member without that role can make a token that counts, and whoever knows a secret that all
members share knows nothing of it.  Signing and encoding are those of ``itsdangerous``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import msgpack
from itsdangerous import BadData, Signer
from itsdangerous.encoding import base64_decode, base64_encode
from itsdangerous.signer import SigningAlgorithm

from middleware.entangled.identity import Identity, verified
from webnode.visitor import Role

ROLES: tuple[Role, ...] = ("viewer", "operator", "phone")
VERSION = 3
SESSION_BYTES = 8
MAX_NAME = 64
MAX_VOUCHERS = 3
"""Web nodes, beside the one that signs, through which a session may have come."""
MAX_PARENTS = 3
MAX_TEXT = 700
REMEMBERED = 512
"""Tokens that are known to be genuine; to verify one takes 80 us, and streams are checked every second."""
MAX_MOMENT = 2**40
DOMAIN = b"swarm-page-1 "


@dataclass(frozen=True)
class Claim:
    """The content of a token.

    ``id`` names the session, ``parents`` the session or invitation of which it was made and with which it ends.
    ``until`` is in whole unix seconds, and so is ``limit``, beyond which no token follows this one.  ``is_ticket``: the
    token was made for the query of a GET.  ``vouchers`` are the public keys of the web nodes that vouch for it.
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
        """The same session with fewer rights, as a URL is seen by more: an operator's ticket may only look."""
        return replace(self, role="phone" if self.role == "phone" else "viewer", is_ticket=True)


class Ed25519(SigningAlgorithm):
    """Signatures by ``identity``, or by nobody: then they are only verified."""

    def __init__(self, identity: Identity | None = None) -> None:
        self._identity = identity

    def get_signature(self, key: bytes, value: bytes) -> bytes:
        """The signature of ``value``; ``key`` is the public key of the identity."""
        assert self._identity is not None and key == self._identity.public
        return self._identity.sign(DOMAIN + value)

    def verify_signature(self, key: bytes, value: bytes, sig: bytes) -> bool:
        """Whether the holder of the public key ``key`` signed ``value``."""
        return verified(key, DOMAIN + value, sig)


class TokenKey:
    """The key with which one web node signs tokens, and reads those that are for it."""

    def __init__(self, identity: Identity) -> None:
        self.public = identity.public
        self.node_id = identity.node_id
        self._signer = _signer(identity.public, Ed25519(identity))
        self._read = lru_cache(REMEMBERED)(self._verify)

    def token(self, claim: Claim, audience: bytes = b"") -> str:
        """The token of ``claim`` for the node with the id ``audience``, else for this one.

        It has letters, digits, ``-``, ``_`` and ``.``.  One for this node need not name it.
        """
        is_own = audience in (b"", self.node_id)
        value = base64_encode(packed(claim, b"" if is_own else audience))
        return self._signer.sign(value if is_own else base64_encode(self.public) + b"." + value).decode()

    def claim(self, text: str) -> Claim | None:
        """The content of a token for this node, with who signed it among its vouchers; None for anything else.

        Whether it is expired, and whether its vouchers may vouch, is for the caller to check.
        """
        return self._read(text) if 0 < len(text) <= MAX_TEXT and text.isascii() else None

    def _verify(self, text: str) -> Claim | None:
        issuer, _, value = text.rpartition(".")[0].rpartition(".")
        is_own = not issuer
        try:
            public = self.public if is_own else base64_decode(issuer)
            if len(public) != len(self.public):
                return None
            _signer(public, Ed25519()).unsign(text)
            return unpacked(base64_decode(value), public, b"" if is_own else self.node_id)
        except (BadData, ValueError, TypeError):
            return None


def _signer(public: bytes, algorithm: Ed25519) -> Signer:
    # The key stands as it is, and names who signs: the algorithm is an asymmetric one.
    return Signer(public, key_derivation="none", algorithm=algorithm)


def packed(claim: Claim, audience: bytes = b"") -> bytes:
    """The bytes of a claim."""
    flags = ROLES.index(claim.role) << 1 | claim.is_ticket
    vouchers = list(claim.vouchers)
    parents = [bytes.fromhex(each) for each in claim.parents]
    fields = [VERSION, flags, claim.until, claim.limit, bytes.fromhex(claim.id), claim.name[:MAX_NAME]]
    return bytes(msgpack.packb([*fields, parents, vouchers, audience]))


def unpacked(data: bytes, issuer: bytes, audience: bytes) -> Claim:
    """The claim in ``data``, which ``issuer`` signed; raises ``ValueError`` where it is none for ``audience``."""
    fields = msgpack.unpackb(data)
    version, flags, until, limit, session, name, parents, vouchers, meant = fields
    is_lawful = (
        version == VERSION
        and type(flags) is int
        and 0 <= flags < 2 * len(ROLES)
        and all(type(each) is int and 0 <= each < MAX_MOMENT for each in (until, limit))
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
        raise ValueError("no claim of a token for this node")
    lineage = tuple(each.hex() for each in parents)
    through = tuple(dict.fromkeys((*vouchers, issuer)))
    return Claim(session.hex(), name, ROLES[flags >> 1], until, bool(flags & 1), limit, lineage, through)
