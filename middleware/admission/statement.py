"""Statement: what an operator signs: grants, invitations, revocations, and the team's secrets.

On the wire and in stores a statement is one msgpack array, ``[kind, field, ..., signature]``.  The Ed25519 signature
covers ``"swarm-team-1 "``, the operator's public key, and the array without the signature: so what is signed for one
team, or for another purpose, says nothing here.  Moments are whole seconds of the wall clock, since statements outlive
every process.  ``opened`` is total: it gives a lawful statement or raises ``Malformed`` or ``Forged``.
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
"""What a member may be; their places are the bits in which roles travel."""
NAME = r"[A-Za-z0-9_-]{1,40}"
NUMBERED = 36
"""Letters of an invitation's name that go before the number of each newcomer by it."""
MAX_USES = 100
MAX_STATEMENT = 65_536
MAX_TERMS = 320
"""Bytes of the sealed terms of an invitation: a join reply has room for them."""
MAX_SEALED = 500
"""Members for whom one statement can carry the team's secret; those beyond ask another member for it."""
MAX_LIFE = 10 * 365 * 86_400
"""Seconds for which a certificate can last."""
REMEMBERED = 7 * 86_400
"""Seconds for which an invitation is remembered that has run out, so that its code is refused by name."""
YEAR = 365 * 86_400
"""Seconds of a certificate's life by default; one that the operator made for so long or longer is renewed."""
EXPIRED_REMEMBERED_S = YEAR
"""Seconds for which the list remembers a renewable certificate that has ended, so that the operator can renew it."""
SECRET_BYTES = 32
MEMBER_ID = 8
MAX_KEPT = MAX_SEALED
"""Members and renewals that one revocation of a bootstrap node can keep."""
_LAST = 2**40
_PUBLIC, _SIGNATURE, _MARK = 32, 64, 16


class Entry:
    """An entry of the membership list.

    Of two entries of one ``slot`` the one of the higher ``rank`` holds; it is remembered ``until`` a moment.
    """

    kind: ClassVar[str]
    public: bytes
    not_before: int
    not_after: int

    @property
    def slot(self) -> tuple[str, bytes]:
        """The kind of the entry and the key that it is about."""
        return self.kind, self.public

    @property
    def rank(self) -> int:
        """The later one holds."""
        return self.not_before

    @property
    def until(self) -> int:
        """As long as it lasts."""
        return self.not_after


@dataclass(frozen=True)
class Grant(Entry):
    """The certificate of a member: who holds ``public`` is called ``name`` and may do what ``roles`` may."""

    kind = "grant"
    public: bytes
    name: str
    roles: tuple[str, ...]
    not_before: int
    not_after: int

    @property
    def until(self) -> int:
        """As long as what was said before of that key could last."""
        return max(self.not_after, self.not_before + MAX_LIFE)

    @property
    def life(self) -> int:
        """The seconds for which the operator made it."""
        return self.not_after - self.not_before


@dataclass(frozen=True)
class Invite(Entry):
    """An invitation: who holds the secret half of ``public`` may bring in ``uses`` newcomers.

    They get ``roles``, for ``life`` seconds from their admission.  A single one is called ``name``; several choose
    their own, or are called ``name-1`` and so on.
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
        """A while longer, so that its code is refused by name."""
        return self.not_after + REMEMBERED

    def allows(self, name: str, wish: str) -> bool:
        """Whether a newcomer that wished to be called ``wish`` (empty: as it comes) can have got ``name`` by it."""
        if self.uses == 1:
            return name == self.name
        return name == wish if wish else name.startswith(f"{self.name[:NUMBERED]}-")


@dataclass(frozen=True)
class Terms(Entry):
    """The sealed terms of the invitation ``public`` (``middleware.admission.code``), until ``not_after``."""

    kind = "terms"
    public: bytes
    sealed: bytes
    not_before: int
    not_after: int

    @property
    def until(self) -> int:
        """A while longer, so that its code is refused by name."""
        return self.not_after + REMEMBERED


@dataclass(frozen=True)
class Revoke(Entry):
    """The end of a member's key, or of an invitation's and with it of all that came by it; there is no way back.

    ``name`` is what people called it.  ``kept`` freezes what a bootstrap node did, whatever dates it signs: of the
    members that it admitted only those with these ids (``member_id``) stay, and of its renewals only those with these
    ids (``renewal_id``) count.
    """

    kind = "revoke"
    public: bytes
    name: str
    at: int
    not_after: int
    kept: tuple[bytes, ...] = ()

    @property
    def rank(self) -> int:
        """The earlier one holds: nothing is taken back by saying it again."""
        return -self.at


@dataclass(frozen=True)
class Secret(Entry):
    """The team's secret of that ``number``, sealed for each member; the one before is accepted for ``grace`` seconds.

    ``sealed`` are pairs of a member's public key and what it alone can open.  By the ``mark`` who was let in meanwhile,
    and asks another member for the secret, knows it.
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
        """The number takes the place of a key."""
        return self.kind, self.number.to_bytes(8)

    @property
    def rank(self) -> int:
        """The later one holds."""
        return self.at

    def opened(self, member: Identity) -> bytes | None:
        """The secret, or None where it was not sealed for ``member``."""
        whole = dict(self.sealed).get(member.public)
        if whole is None:
            return None
        try:
            found = unsealed(whole, member.exchange_secret, _shared(self.number), b"")
        except Forged:
            return None
        return found if self.is_it(found) else None

    def is_it(self, secret: bytes) -> bool:
        """Whether ``secret`` is the one that the operator meant."""
        return len(secret) == SECRET_BYTES and mark_of(secret) == self.mark


Statement = Grant | Invite | Revoke | Secret | Terms
_KINDS: tuple[type[Any], ...] = (Grant, Invite, Revoke, Secret, Terms)
_Kind = TypeVar("_Kind", Grant, Invite, Revoke, Secret, Terms)


def sealed_secret(
    secret: bytes, number: int, members: Iterable[bytes], at: int, grace: int, rng: random.Random
) -> Secret:
    """The statement that gives ``secret`` to those ``members`` (public keys) and to nobody else."""
    pairs = [(each, sealed(secret, exchange_key(each), _shared(number), b"", rng)) for each in sorted(members)]
    return Secret(number, at, grace, at + MAX_LIFE, mark_of(secret), tuple(pairs))


def member_id(public: bytes) -> bytes:
    """Return the id by which a revocation names a member that it keeps."""
    return hashlib.blake2s(public, digest_size=MEMBER_ID, person=b"member").digest()


def renewal_id(public: bytes, not_after: int) -> bytes:
    """Return the id by which a revocation names a renewal that it keeps: that of ``public`` until ``not_after``."""
    return hashlib.blake2s(public + not_after.to_bytes(8), digest_size=MEMBER_ID, person=b"renewal").digest()


def remembered_until(not_after: int, life: int) -> int:
    """Return until when the list remembers a certificate that ends at ``not_after`` and was made for ``life`` seconds.

    What is not renewable goes when it ends.
    """
    return not_after + (EXPIRED_REMEMBERED_S if life >= YEAR else 0)


def mark_of(secret: bytes) -> bytes:
    """What may be known of a secret by everybody."""
    return hashlib.blake2s(secret, digest_size=_MARK, person=b"secret").digest()


def signed(operator: Identity, statement: Statement) -> bytes:
    """``statement`` packed and signed; raises ``ValueError`` where it breaks a rule."""
    fields = _fields(statement)
    try:
        _checked(fields)
    except Malformed as error:
        raise ValueError(str(error)) from error
    whole: bytes = msgpack.packb([*fields, operator.sign(_covered(operator.public, fields))])
    if len(whole) > MAX_STATEMENT:
        raise ValueError(f"a statement has at most {MAX_STATEMENT} bytes, this one {len(whole)}")
    return whole


def opened(operator: bytes, whole: object) -> Statement:
    """The statement in ``whole``, if the holder of ``operator`` signed it; raises ``Malformed`` or ``Forged``."""
    fields = unpacked(whole)
    signature = fields.pop() if fields else None
    statement = _checked(fields)
    if not isinstance(signature, bytes) or len(signature) != _SIGNATURE:
        raise Malformed("a statement ends with a signature")
    if not verified(operator, _covered(operator, fields), signature):
        raise Forged("a statement that this team's operator did not sign")
    return statement


def unpacked(whole: object) -> list[Any]:
    """The fields of an array of this room; raises ``Malformed``."""
    if not isinstance(whole, bytes) or len(whole) > MAX_STATEMENT:
        raise Malformed("a statement is a string of bytes, and not a long one")
    try:
        fields = msgpack.unpackb(whole, max_ext_len=0, max_map_len=0, max_array_len=MAX_SEALED)
    except Exception as error:  # the one place where foreign bytes are unpacked
        raise Malformed("a statement that is not msgpack") from error
    if not isinstance(fields, list) or msgpack.packb(fields) != whole:
        # In the shortest form alone: what is the same statement shall have the same digest.
        raise Malformed("a statement that is not packed as it should be")
    return fields


def bits_of(roles: Sequence[str]) -> int:
    """Roles as they travel."""
    return sum(1 << ROLES.index(role) for role in set(roles))


def roles_of(bits: object) -> tuple[str, ...]:
    """The roles that ``bits`` stand for; raises ``Malformed``."""
    if not isinstance(bits, int) or isinstance(bits, bool) or not 0 < bits < 1 << len(ROLES):
        raise Malformed("roles that nobody can have")
    return tuple(role for place, role in enumerate(ROLES) if bits >> place & 1)


def moment(value: object, least: int = 0, most: int = _LAST) -> int:
    """``value`` if it is a whole number from ``least`` to ``most``; raises ``Malformed``."""
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise Malformed("a number that cannot be one of a statement")
    return value


def named(value: object) -> str:
    """``value`` if it can be a name; raises ``Malformed``."""
    if not isinstance(value, str) or not re.fullmatch(NAME, value, re.ASCII):
        raise Malformed("a name that nobody can have")
    return value


def sized(value: object, size: int) -> bytes:
    """``value`` if it is so many bytes; raises ``Malformed``."""
    if not isinstance(value, bytes) or len(value) != size:
        raise Malformed("a field of the wrong size")
    return value


def _fields(statement: Statement) -> list[Any]:
    kind = _KINDS.index(type(statement))
    if isinstance(statement, Secret):
        pairs = [list(pair) for pair in statement.sealed]
        return [kind, statement.number, statement.at, statement.grace, statement.not_after, statement.mark, pairs]
    if isinstance(statement, Terms):
        return [kind, statement.public, statement.sealed, statement.not_before, statement.not_after]
    head = [kind, statement.public, statement.name]
    if isinstance(statement, Revoke):
        # An empty list is left out: so is a statement of version 0.1, which knew none.
        return [*head, statement.at, statement.not_after, *([list(statement.kept)] if statement.kept else [])]
    head.append(bits_of(statement.roles))
    if isinstance(statement, Grant):
        return [*head, statement.not_before, statement.not_after]
    return [*head, statement.uses, statement.not_before, statement.not_after, statement.life]


def _checked(fields: list[Any]) -> Statement:
    """The statement that ``fields`` (the kind first, no signature) say; raises ``Malformed``."""
    try:
        kind, *rest = fields
        if kind == 0:
            public, name, bits, begin, end = rest
            grant = Grant(sized(public, _PUBLIC), named(name), roles_of(bits), moment(begin), moment(end))
            return _lasting(grant, grant.not_before, grant.not_after)
        if kind == 1:
            public, name, bits, uses, begin, end, life = rest
            times = moment(begin), moment(end), moment(life, 1, MAX_LIFE)
            invite = Invite(sized(public, _PUBLIC), named(name), roles_of(bits), moment(uses, 1, MAX_USES), *times)
            return _lasting(invite, invite.not_before, invite.not_after)
        if kind == 2:
            public, name, at, end, *more = rest
            kept = tuple(sized(each, MEMBER_ID) for [ids] in [more] for each in ids) if more else ()
            revoke = Revoke(sized(public, _PUBLIC), named(name), moment(at), moment(end), kept)
            return _lasting(revoke, revoke.at, revoke.not_after)
        if kind == 3:
            number, at, grace, end, mark, pairs = rest
            if not isinstance(pairs, list) or not pairs:
                raise Malformed("a secret for nobody")
            size = SECRET_BYTES + OVERHEAD
            each = tuple((sized(public, _PUBLIC), sized(whole, size)) for public, whole in pairs)
            times = moment(at), moment(grace, 0, MAX_LIFE), moment(end)
            secret = Secret(moment(number, 1), *times, sized(mark, _MARK), each)
            return _lasting(secret, secret.at, secret.not_after)
        if kind == 4:
            public, sealed, begin, end = rest
            if not isinstance(sealed, bytes) or len(sealed) > MAX_TERMS:
                raise Malformed("terms that are too long")
            terms = Terms(sized(public, _PUBLIC), sealed, moment(begin), moment(end))
            return _lasting(terms, terms.not_before, terms.not_after)
    except (ValueError, TypeError) as error:
        raise Malformed("a statement with other fields than it should have") from error
    raise Malformed("a statement of no known kind")


def _lasting(statement: _Kind, begin: int, end: int) -> _Kind:
    if not begin < end <= begin + 2 * MAX_LIFE:
        raise Malformed("a statement that ends before it begins, or lasts too long")
    return statement


def _covered(operator: bytes, fields: list[Any]) -> bytes:
    return DOMAIN + operator + bytes(msgpack.packb(fields))


def _shared(number: int) -> bytes:
    return hashlib.blake2s(DOMAIN + number.to_bytes(8), person=b"number").digest()
