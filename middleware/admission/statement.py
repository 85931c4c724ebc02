"""Statements that an operator signs: grants, invitations, revocations, and the team's secrets.

A statement is packed as one msgpack array, ``[kind, field, ..., signature]``.  The Ed25519 signature covers
``"swarm-team-1 "``, the operator's public key, and the array without the signature, so a signature for another team or
another purpose is not valid.  Times are whole seconds of the wall clock, because statements outlive every process.
``opened`` is total: for any input it returns a valid statement or raises ``Malformed`` or ``Forged``.
"""

from __future__ import annotations

import hashlib
import random
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import msgpack

from middleware.admission.sealed import OVERHEAD, sealed
from middleware.admission.sealed import opened as unsealed
from middleware.entangled.errors import Forged, Malformed
from middleware.entangled.identity import Identity, exchange_key, verified

DOMAIN = b"swarm-team-1 "
ROLES = ("device", "operator", "viewer", "gateway", "bootstrap")
"""Roles of members; the position of a role is its bit on the wire."""
NAME = r"[A-Za-z0-9_-]{1,40}"
NUMBERED = 36
"""Number of letters of an invitation's name that precede the number of each newcomer."""
MAX_USES = 100
MAX_STATEMENT = 65_536
MAX_TERMS = 320
"""Maximum size in bytes of the encrypted terms of an invitation: they have to fit into a join reply."""
MAX_SEALED = 500
"""Maximum number of members to which one statement carries the team's secret; others request it from a member."""
MAX_LIFE = 10 * 365 * 86_400
"""Maximum validity of a certificate, in seconds."""
REMEMBERED = 7 * 86_400
"""Seconds for which an expired invitation is kept, so that its code is refused as expired."""
YEAR = 365 * 86_400
"""Default validity of a certificate, in seconds; certificates of this length or longer are renewed."""
EXPIRED_REMEMBERED_S = YEAR
"""Seconds for which the list keeps an expired renewable certificate, so that the operator can renew it."""
SECRET_BYTES = 32
MEMBER_ID = 8
MAX_KEPT = MAX_SEALED
"""Maximum number of members and renewals that one revocation of a bootstrap node can keep."""
_MAX_TIME_S = 2**40
_PUBLIC_BYTES, _SIGNATURE_BYTES, _MARK_BYTES = 32, 64, 16


class Entry:
    """An entry of the membership list.

    Of two entries with the same ``slot`` the one with the higher ``rank`` wins.  An entry is kept ``until`` a time.
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
        """The later entry wins."""
        return self.not_before

    @property
    def until(self) -> int:
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
    def until(self) -> int:
        """The time at which all earlier statements about the key have expired."""
        return max(self.not_after, self.not_before + MAX_LIFE)

    @property
    def life(self) -> int:
        """The seconds for which the operator issued it."""
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
    def until(self) -> int:
        """A week after the end date; until then the code is refused as expired."""
        return self.not_after + REMEMBERED

    def allows(self, name: str, wish: str) -> bool:
        """Return whether a newcomer that asked for the name ``wish`` (empty: any) can have got ``name``."""
        if self.uses == 1:
            return name == self.name
        return name == wish if wish else name.startswith(f"{self.name[:NUMBERED]}-")


@dataclass(frozen=True)
class Terms(Entry):
    """The encrypted terms of the invitation ``public`` (``middleware.admission.code``), until ``not_after``."""

    kind = "terms"
    public: bytes
    sealed: bytes
    not_before: int
    not_after: int

    @property
    def until(self) -> int:
        """A week after the end date; until then the code is refused as expired."""
        return self.not_after + REMEMBERED


@dataclass(frozen=True)
class Revoke(Entry):
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
        """The earlier revocation wins: a later one cannot change it."""
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
    mark: bytes
    sealed: tuple[tuple[bytes, bytes], ...]

    @property
    def slot(self) -> tuple[str, bytes]:
        """The kind, and the number in place of a key."""
        return self.kind, self.number.to_bytes(8)

    @property
    def rank(self) -> int:
        """The later statement wins."""
        return self.at

    def opened(self, member: Identity) -> bytes | None:
        """Return the secret, or None if it was not encrypted for ``member``."""
        packed = dict(self.sealed).get(member.public)
        if packed is None:
            return None
        try:
            found = unsealed(packed, member.exchange_secret, _derive_shared(self.number), b"")
        except Forged:
            return None
        return found if self.is_it(found) else None

    def is_it(self, secret: bytes) -> bool:
        """Return whether ``secret`` is the secret of this statement."""
        return len(secret) == SECRET_BYTES and mark_of(secret) == self.mark


Statement = Grant | Invite | Revoke | Secret | Terms
_KINDS: tuple[type[Any], ...] = (Grant, Invite, Revoke, Secret, Terms)
_Kind = TypeVar("_Kind", Grant, Invite, Revoke, Secret, Terms)


def sealed_secret(
    secret: bytes, number: int, members: Iterable[bytes], at: int, grace: int, rng: random.Random
) -> Secret:
    """Return the statement that gives ``secret`` to the ``members`` (public keys) only."""
    pairs = [(each, sealed(secret, exchange_key(each), _derive_shared(number), b"", rng)) for each in sorted(members)]
    return Secret(number, at, grace, at + MAX_LIFE, mark_of(secret), tuple(pairs))


def member_id(public: bytes) -> bytes:
    """Return the id by which a revocation names a member that stays."""
    return hashlib.blake2s(public, digest_size=MEMBER_ID, person=b"member").digest()


def renewal_id(public: bytes, not_after: int) -> bytes:
    """Return the id by which a revocation names a renewal that stays: of the key ``public``, until ``not_after``."""
    return hashlib.blake2s(public + not_after.to_bytes(8), digest_size=MEMBER_ID, person=b"renewal").digest()


def remembered_until(not_after: int, life: int) -> int:
    """Return the time until which the list keeps a certificate with this end and validity, in seconds.

    A certificate that is not renewable is dropped at its end.
    """
    return not_after + (EXPIRED_REMEMBERED_S if life >= YEAR else 0)


def mark_of(secret: bytes) -> bytes:
    """Return the public fingerprint of a secret."""
    return hashlib.blake2s(secret, digest_size=_MARK_BYTES, person=b"secret").digest()


def signed(operator: Identity, statement: Statement) -> bytes:
    """Pack and sign ``statement``; raises ``ValueError`` if it is not valid."""
    fields = _to_fields(statement)
    try:
        _parse_fields(fields)
    except Malformed as error:
        raise ValueError(str(error)) from error
    packed: bytes = msgpack.packb([*fields, operator.sign(_signed_content(operator.public, fields))])
    if len(packed) > MAX_STATEMENT:
        raise ValueError(f"a statement has at most {MAX_STATEMENT} bytes, this one {len(packed)}")
    return packed


def opened(operator: bytes, packed: object) -> Statement:
    """Parse ``packed`` and verify the signature of ``operator``; raises ``Malformed`` or ``Forged``."""
    fields = unpacked(packed)
    signature = fields.pop() if fields else None
    statement = _parse_fields(fields)
    if not isinstance(signature, bytes) or len(signature) != _SIGNATURE_BYTES:
        raise Malformed("the statement does not end with a signature")
    if not verified(operator, _signed_content(operator, fields), signature):
        raise Forged("the statement is not signed by this team's operator")
    return statement


def unpacked(packed: object) -> list[Any]:
    """Unpack a msgpack array of at most ``MAX_STATEMENT`` bytes; raises ``Malformed``."""
    if not isinstance(packed, bytes) or len(packed) > MAX_STATEMENT:
        raise Malformed(f"a statement has to be at most {MAX_STATEMENT} bytes")
    try:
        fields = msgpack.unpackb(packed, max_ext_len=0, max_map_len=0, max_array_len=MAX_SEALED)
    except Exception as error:  # untrusted bytes
        raise Malformed("the statement is not msgpack") from error
    if not isinstance(fields, list) or msgpack.packb(fields) != packed:
        # Only the shortest encoding is valid: equal statements must have equal digests.
        raise Malformed("the statement is not in the shortest msgpack encoding")
    return fields


def bits_of(roles: Sequence[str]) -> int:
    """Return roles as bits."""
    return sum(1 << ROLES.index(role) for role in set(roles))


def roles_of(bits: object) -> tuple[str, ...]:
    """Return the roles that ``bits`` encode; raises ``Malformed``."""
    if not isinstance(bits, int) or isinstance(bits, bool) or not 0 < bits < 1 << len(ROLES):
        raise Malformed("the roles are not valid")
    return tuple(role for place, role in enumerate(ROLES) if bits >> place & 1)


def moment(value: object, least: int = 0, most: int = _MAX_TIME_S) -> int:
    """Return ``value`` if it is a whole number from ``least`` to ``most``; raises ``Malformed``."""
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise Malformed(f"a number in the statement is not between {least} and {most}")
    return value


def named(value: object) -> str:
    """Return ``value`` if it is a valid name; raises ``Malformed``."""
    if not isinstance(value, str) or not re.fullmatch(NAME, value, re.ASCII):
        raise Malformed("the name is not valid")
    return value


def sized(value: object, size: int) -> bytes:
    """Return ``value`` if it is bytes of length ``size``; raises ``Malformed``."""
    if not isinstance(value, bytes) or len(value) != size:
        raise Malformed(f"a field does not have {size} bytes")
    return value


def _to_fields(statement: Statement) -> list[Any]:
    kind = _KINDS.index(type(statement))
    if isinstance(statement, Secret):
        pairs = [list(pair) for pair in statement.sealed]
        return [kind, statement.number, statement.at, statement.grace, statement.not_after, statement.mark, pairs]
    if isinstance(statement, Terms):
        return [kind, statement.public, statement.sealed, statement.not_before, statement.not_after]
    head = [kind, statement.public, statement.name]
    if isinstance(statement, Revoke):
        # An empty list is omitted, because statements of version 0.1 do not have it.
        return [*head, statement.at, statement.not_after, *([list(statement.kept)] if statement.kept else [])]
    head.append(bits_of(statement.roles))
    if isinstance(statement, Grant):
        return [*head, statement.not_before, statement.not_after]
    return [*head, statement.uses, statement.not_before, statement.not_after, statement.life]


def _parse_fields(fields: list[Any]) -> Statement:
    """Parse ``fields`` (the kind first, no signature) as a statement; raises ``Malformed``."""
    try:
        kind, *rest = fields
        if kind == 0:
            public, name, bits, begin, end = rest
            grant = Grant(sized(public, _PUBLIC_BYTES), named(name), roles_of(bits), moment(begin), moment(end))
            return _check_dates(grant, grant.not_before, grant.not_after)
        if kind == 1:
            public, name, bits, uses, begin, end, life = rest
            times = moment(begin), moment(end), moment(life, 1, MAX_LIFE)
            invite = Invite(
                sized(public, _PUBLIC_BYTES), named(name), roles_of(bits), moment(uses, 1, MAX_USES), *times
            )
            return _check_dates(invite, invite.not_before, invite.not_after)
        if kind == 2:
            public, name, at, end, *more = rest
            kept = tuple(sized(each, MEMBER_ID) for [ids] in [more] for each in ids) if more else ()
            revoke = Revoke(sized(public, _PUBLIC_BYTES), named(name), moment(at), moment(end), kept)
            return _check_dates(revoke, revoke.at, revoke.not_after)
        if kind == 3:
            number, at, grace, end, mark, pairs = rest
            if not isinstance(pairs, list) or not pairs:
                raise Malformed("the secret is for no member")
            size = SECRET_BYTES + OVERHEAD
            each = tuple((sized(public, _PUBLIC_BYTES), sized(packed, size)) for public, packed in pairs)
            times = moment(at), moment(grace, 0, MAX_LIFE), moment(end)
            secret = Secret(moment(number, 1), *times, sized(mark, _MARK_BYTES), each)
            return _check_dates(secret, secret.at, secret.not_after)
        if kind == 4:
            public, sealed, begin, end = rest
            if not isinstance(sealed, bytes) or len(sealed) > MAX_TERMS:
                raise Malformed(f"the terms have more than {MAX_TERMS} bytes")
            terms = Terms(sized(public, _PUBLIC_BYTES), sealed, moment(begin), moment(end))
            return _check_dates(terms, terms.not_before, terms.not_after)
    except (ValueError, TypeError) as error:
        raise Malformed("the statement has invalid fields") from error
    raise Malformed("the statement is of an unknown kind")


def _check_dates(statement: _Kind, begin: int, end: int) -> _Kind:
    if not begin < end <= begin + 2 * MAX_LIFE:
        raise Malformed("the statement ends before it begins, or lasts too long")
    return statement


def _signed_content(operator: bytes, fields: list[Any]) -> bytes:
    return DOMAIN + operator + bytes(msgpack.packb(fields))


def _derive_shared(number: int) -> bytes:
    return hashlib.blake2s(DOMAIN + number.to_bytes(8), person=b"number").digest()
