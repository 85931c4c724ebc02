"""Statements that an operator signs: grants, invitations, revocations, and the team's secrets.

A statement is packed as one msgpack array, ``[kind, field, ..., signature]``.  The Ed25519 signature covers
``"swarm-team-1 "``, the operator's public key, and the array without the signature, so a signature for a different team
or a different purpose is not valid.  Times are whole seconds of the wall clock, because statements outlive every
process.  ``open_statement`` is total: for any input it returns a valid statement or raises ``Malformed`` or ``Forged``.
"""

from __future__ import annotations

import hashlib
import random
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import msgpack

from middleware.admission.sealed_box import OVERHEAD_BYTES, seal
from middleware.admission.sealed_box import unseal as unsealed
from middleware.entangled.errors import Forged, Malformed
from middleware.entangled.identity import Identity, derive_exchange_key, is_signature_valid

DOMAIN = b"swarm-team-1 "
ROLES = ("device", "operator", "viewer", "gateway", "bootstrap")
"""Roles of members; the index of a role is the number of its bit in messages."""
NAME_PATTERN = r"[A-Za-z0-9_-]{1,40}"
NAME_PREFIX_LETTERS = 36
"""Number of letters of an invitation's name that precede the number of each newcomer."""
MAX_USES = 100
MAX_STATEMENT_BYTES = 65_536
MAX_TERMS_BYTES = 320
"""Maximum size in bytes of the encrypted terms of an invitation: they have to fit into a join reply."""
MAX_SECRET_RECIPIENTS = 500
"""Maximum number of members for which one statement contains the team's secret; further members request it from a
member that has it."""
MAX_LIFE_S = 10 * 365 * 86_400
"""Maximum validity of a certificate, in seconds."""
INVITATION_REMEMBERED_S = 7 * 86_400
"""Seconds for which an expired invitation is kept, so that its code is refused as expired."""
DEFAULT_LIFE_S = 365 * 86_400
"""Default validity of a certificate, in seconds; certificates of this length or longer are renewed."""
EXPIRED_REMEMBERED_S = DEFAULT_LIFE_S
"""Seconds for which the list keeps an expired renewable certificate, so that the operator can renew it."""
SECRET_BYTES = 32
MEMBER_ID_BYTES = 8
MAX_KEPT = MAX_SECRET_RECIPIENTS
"""Maximum number of members and renewals that one revocation of a bootstrap node can keep."""
_MAX_TIME_S = 2**40
_PUBLIC_BYTES, _SIGNATURE_BYTES, _FINGERPRINT_BYTES = 32, 64, 16


class Entry:
    """An entry of the membership list.

    Of two entries with the same ``slot``, the one with the higher ``rank`` is valid.  An entry expires at
    ``kept_until``.
    """

    kind: ClassVar[str]
    public: bytes
    not_before: int
    not_after: int

    @property
    def slot(self) -> tuple[str, bytes]:
        """The kind of the entry and the key that it describes."""
        return self.kind, self.public

    @property
    def rank(self) -> int:
        """The sort key: the later entry is valid."""
        return self.not_before

    @property
    def kept_until(self) -> int:
        """The end date."""
        return self.not_after


@dataclass(frozen=True)
class Grant(Entry):
    """The certificate of a member: the key ``public`` has the name ``name`` and the roles ``roles``."""

    kind = "grant"
    public: bytes
    name: str
    roles: tuple[str, ...]
    not_before: int
    not_after: int

    @property
    def kept_until(self) -> int:
        """The time at which all earlier statements about the key have expired."""
        return max(self.not_after, self.not_before + MAX_LIFE_S)

    @property
    def life(self) -> int:
        """The seconds for which the operator issued the certificate."""
        return self.not_after - self.not_before


@dataclass(frozen=True)
class Invite(Entry):
    """An invitation: the holder of the secret half of ``public`` can admit ``uses`` newcomers.

    Newcomers get ``roles`` for ``life`` seconds from their admission.  A single newcomer gets the name ``name``;
    several choose their names, or are named ``name-1`` and so on.
    """

    kind = "invite"
    public: bytes
    name: str
    roles: tuple[str, ...]
    uses: int
    not_before: int
    not_after: int
    life: int

    @property
    def kept_until(self) -> int:
        """The end of storage, a week after the end date: until then the code is refused as expired."""
        return self.not_after + INVITATION_REMEMBERED_S

    def allows(self, name: str, requested_name: str) -> bool:
        """Return whether a newcomer that asked for the name ``requested_name`` (empty: any) can have got ``name``."""
        if self.uses == 1:
            return name == self.name
        return name == requested_name if requested_name else name.startswith(f"{self.name[:NAME_PREFIX_LETTERS]}-")


@dataclass(frozen=True)
class Terms(Entry):
    """The encrypted terms of the invitation ``public`` (``middleware.admission.join_code``), until ``not_after``."""

    kind = "terms"
    public: bytes
    sealed: bytes
    not_before: int
    not_after: int

    @property
    def kept_until(self) -> int:
        """The end of storage, a week after the end date: until then the code is refused as expired."""
        return self.not_after + INVITATION_REMEMBERED_S


@dataclass(frozen=True)
class Revocation(Entry):
    """The irreversible revocation of a member's key, or of an invitation's key and all members that joined by it.

    ``name`` is for display.  If the key is a bootstrap node's, ``kept`` limits its earlier signatures, whatever
    dates they have: only the admitted members with these ids (``member_id``) stay members, and only the renewals with
    these ids (``renewal_id``) stay valid.
    """

    kind = "revoke"
    public: bytes
    name: str
    at: int
    not_after: int
    kept: tuple[bytes, ...] = ()

    @property
    def rank(self) -> int:
        """The sort key: the earlier revocation is valid, so a later one cannot change it."""
        return -self.at


@dataclass(frozen=True)
class Secret(Entry):
    """A team secret, encrypted for each member; the previous one is accepted for ``grace`` seconds.

    ``sealed`` are pairs of a member's public key and the secret encrypted to it.  A member that joined later requests
    the secret from another member, and verifies it by ``mark``.
    """

    kind = "secret"
    number: int
    at: int
    grace: int
    not_after: int
    fingerprint: bytes
    sealed: tuple[tuple[bytes, bytes], ...]

    @property
    def slot(self) -> tuple[str, bytes]:
        """The kind, and the number in place of a key."""
        return self.kind, self.number.to_bytes(8)

    @property
    def rank(self) -> int:
        """The sort key: the later statement is valid."""
        return self.at

    def decrypt(self, member: Identity) -> bytes | None:
        """Return the secret, or None if it was not encrypted for ``member``."""
        packed = dict(self.sealed).get(member.public)
        if packed is None:
            return None
        try:
            found = unsealed(packed, member.exchange_secret, _derive_shared(self.number), b"")
        except Forged:
            return None
        return found if self.matches(found) else None

    def matches(self, secret: bytes) -> bool:
        """Return whether ``secret`` is the secret of this statement."""
        return len(secret) == SECRET_BYTES and compute_fingerprint(secret) == self.fingerprint


Statement = Grant | Invite | Revocation | Secret | Terms
_KINDS: tuple[type[Any], ...] = (Grant, Invite, Revocation, Secret, Terms)
_Kind = TypeVar("_Kind", Grant, Invite, Revocation, Secret, Terms)


def seal_secret(
    secret: bytes, number: int, members: Iterable[bytes], at: int, grace: int, rng: random.Random
) -> Secret:
    """Return the statement that gives ``secret`` to the ``members`` (public keys) only."""
    pairs = [
        (each, seal(secret, derive_exchange_key(each), _derive_shared(number), b"", rng)) for each in sorted(members)
    ]
    return Secret(number, at, grace, at + MAX_LIFE_S, compute_fingerprint(secret), tuple(pairs))


def member_id(public: bytes) -> bytes:
    """Return the id with which a revocation lists a member that remains a member."""
    return hashlib.blake2s(public, digest_size=MEMBER_ID_BYTES, person=b"member").digest()


def renewal_id(public: bytes, not_after: int) -> bytes:
    """Return the id with which a revocation lists a renewal that remains valid."""
    return hashlib.blake2s(public + not_after.to_bytes(8), digest_size=MEMBER_ID_BYTES, person=b"renewal").digest()


def compute_retention_end(not_after: int, life: int) -> int:
    """Return the time until which the list keeps a certificate with this end and validity, in seconds.

    A certificate that is not renewable is dropped at its end.
    """
    return not_after + (EXPIRED_REMEMBERED_S if life >= DEFAULT_LIFE_S else 0)


def compute_fingerprint(secret: bytes) -> bytes:
    """Return the public fingerprint of a secret."""
    return hashlib.blake2s(secret, digest_size=_FINGERPRINT_BYTES, person=b"secret").digest()


def sign_statement(operator: Identity, statement: Statement) -> bytes:
    """Pack and sign ``statement``; raises ``ValueError`` if it is not valid."""
    fields = _to_fields(statement)
    try:
        _parse_fields(fields)
    except Malformed as error:
        raise ValueError(str(error)) from error
    packed: bytes = msgpack.packb([*fields, operator.sign(_signed_content(operator.public, fields))])
    if len(packed) > MAX_STATEMENT_BYTES:
        raise ValueError(f"a statement must have at most {MAX_STATEMENT_BYTES} bytes, not {len(packed)}")
    return packed


def open_statement(operator: bytes, packed: object) -> Statement:
    """Parse ``packed`` and verify the signature of ``operator``; raises ``Malformed`` or ``Forged``."""
    fields = unpack_fields(packed)
    signature = fields.pop() if fields else None
    statement = _parse_fields(fields)
    if not isinstance(signature, bytes) or len(signature) != _SIGNATURE_BYTES:
        raise Malformed("the statement does not end with a signature")
    if not is_signature_valid(operator, _signed_content(operator, fields), signature):
        raise Forged("the statement is not signed by this team's operator")
    return statement


def unpack_fields(packed: object) -> list[Any]:
    """Unpack a msgpack array of at most ``MAX_STATEMENT_BYTES`` bytes; raises ``Malformed``."""
    if not isinstance(packed, bytes) or len(packed) > MAX_STATEMENT_BYTES:
        raise Malformed(f"a statement must be at most {MAX_STATEMENT_BYTES} bytes")
    try:
        fields = msgpack.unpackb(packed, max_ext_len=0, max_map_len=0, max_array_len=MAX_SECRET_RECIPIENTS)
    except Exception as error:  # untrusted bytes
        raise Malformed("the statement is not msgpack") from error
    if not isinstance(fields, list) or msgpack.packb(fields) != packed:
        # Only the shortest encoding is valid: equal statements must have equal digests.
        raise Malformed("the statement is not in the shortest msgpack encoding")
    return fields


def pack_roles(roles: Sequence[str]) -> int:
    """Return roles as bits."""
    return sum(1 << ROLES.index(role) for role in set(roles))


def unpack_roles(bits: object) -> tuple[str, ...]:
    """Return the roles that ``bits`` encode; raises ``Malformed``."""
    if not isinstance(bits, int) or isinstance(bits, bool) or not 0 < bits < 1 << len(ROLES):
        raise Malformed("the roles are not valid")
    return tuple(role for place, role in enumerate(ROLES) if bits >> place & 1)


def check_number(value: object, least: int = 0, most: int = _MAX_TIME_S) -> int:
    """Return ``value`` if it is a whole number from ``least`` to ``most``; raises ``Malformed``."""
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise Malformed(f"a number in the statement is not between {least} and {most}")
    return value


def check_name(value: object) -> str:
    """Return ``value`` if it is a valid name; raises ``Malformed``."""
    if not isinstance(value, str) or not re.fullmatch(NAME_PATTERN, value, re.ASCII):
        raise Malformed("the name is not valid")
    return value


def check_bytes(value: object, size: int) -> bytes:
    """Return ``value`` if it is bytes of length ``size``; raises ``Malformed``."""
    if not isinstance(value, bytes) or len(value) != size:
        raise Malformed(f"a field does not have {size} bytes")
    return value


def _to_fields(statement: Statement) -> list[Any]:
    kind = _KINDS.index(type(statement))
    if isinstance(statement, Secret):
        pairs = [list(pair) for pair in statement.sealed]
        return [
            kind,
            statement.number,
            statement.at,
            statement.grace,
            statement.not_after,
            statement.fingerprint,
            pairs,
        ]
    if isinstance(statement, Terms):
        return [kind, statement.public, statement.sealed, statement.not_before, statement.not_after]
    head = [kind, statement.public, statement.name]
    if isinstance(statement, Revocation):
        # An empty list is omitted, because statements of version 0.1 do not have it.
        return [*head, statement.at, statement.not_after, *([list(statement.kept)] if statement.kept else [])]
    head.append(pack_roles(statement.roles))
    if isinstance(statement, Grant):
        return [*head, statement.not_before, statement.not_after]
    return [*head, statement.uses, statement.not_before, statement.not_after, statement.life]


def _parse_fields(fields: list[Any]) -> Statement:
    """Parse ``fields`` (the kind first, no signature) as a statement; raises ``Malformed``."""
    try:
        kind, *rest = fields
        if kind == 0:
            public, name, bits, begin, end = rest
            grant = Grant(
                check_bytes(public, _PUBLIC_BYTES),
                check_name(name),
                unpack_roles(bits),
                check_number(begin),
                check_number(end),
            )
            return _check_dates(grant, grant.not_before, grant.not_after)
        if kind == 1:
            public, name, bits, uses, begin, end, life = rest
            times = check_number(begin), check_number(end), check_number(life, 1, MAX_LIFE_S)
            invite = Invite(
                check_bytes(public, _PUBLIC_BYTES),
                check_name(name),
                unpack_roles(bits),
                check_number(uses, 1, MAX_USES),
                *times,
            )
            return _check_dates(invite, invite.not_before, invite.not_after)
        if kind == 2:
            public, name, at, end, *more = rest
            kept = tuple(check_bytes(each, MEMBER_ID_BYTES) for [ids] in [more] for each in ids) if more else ()
            revoke = Revocation(
                check_bytes(public, _PUBLIC_BYTES), check_name(name), check_number(at), check_number(end), kept
            )
            return _check_dates(revoke, revoke.at, revoke.not_after)
        if kind == 3:
            number, at, grace, end, mark, pairs = rest
            if not isinstance(pairs, list) or not pairs:
                raise Malformed("the secret has no recipient")
            size = SECRET_BYTES + OVERHEAD_BYTES
            each = tuple((check_bytes(public, _PUBLIC_BYTES), check_bytes(packed, size)) for public, packed in pairs)
            times = check_number(at), check_number(grace, 0, MAX_LIFE_S), check_number(end)
            secret = Secret(check_number(number, 1), *times, check_bytes(mark, _FINGERPRINT_BYTES), each)
            return _check_dates(secret, secret.at, secret.not_after)
        if kind == 4:
            public, sealed, begin, end = rest
            if not isinstance(sealed, bytes) or len(sealed) > MAX_TERMS_BYTES:
                raise Malformed(f"the terms have more than {MAX_TERMS_BYTES} bytes")
            terms = Terms(check_bytes(public, _PUBLIC_BYTES), sealed, check_number(begin), check_number(end))
            return _check_dates(terms, terms.not_before, terms.not_after)
    except (ValueError, TypeError) as error:
        raise Malformed("the statement has invalid fields") from error
    raise Malformed("the statement is of an unknown kind")


def _check_dates(statement: _Kind, begin: int, end: int) -> _Kind:
    if not begin < end <= begin + 2 * MAX_LIFE_S:
        raise Malformed("the statement ends before it begins, or lasts too long")
    return statement


def _signed_content(operator: bytes, fields: list[Any]) -> bytes:
    return DOMAIN + operator + bytes(msgpack.packb(fields))


def _derive_shared(number: int) -> bytes:
    return hashlib.blake2s(DOMAIN + number.to_bytes(8), person=b"number").digest()
