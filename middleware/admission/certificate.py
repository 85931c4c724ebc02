"""Certificate: what a member shows of itself when it opens a session (its *pass*), and what of it is believed.

A pass is one msgpack array, of at most ``ROOM`` bytes: either the operator's grant, or a chain, which takes two to
make: ``[1, invite, wish, proof, name, not before, not after, signature, grant]``.  The ``proof`` is the invitation's
signature under the newcomer's key and the name that it wished for; the ``signature`` that of the bootstrap node which
let it in, and whose own ``grant``, by the operator, has the role ``bootstrap``.  So a bootstrap node alone can admit
nobody, and neither can a code that leaked.

``[3, word, not before, not after, signature, grant]`` renews one of these two: ``word`` is what the operator said of
the member, ``[grant]`` or ``[invite, wish, proof, name, admitter]``, and ``signature`` that of a bootstrap node, whose
``grant`` follows.  Name and roles are those of ``word``, so a renewal changes nothing but the dates.  Only what the
operator made for ``YEAR`` or longer is renewed, and only a bootstrap node of that kind renews.

Another kind is that of a guest, such as a visitor's phone: ``[2, name, not before, not after, signature, gateway,
pass]``.  A member with the role ``gateway`` vouches for it, for a day at most, and its guests are gone with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import msgpack

from middleware.admission.statement import YEAR, Grant, Invite, moment, named, opened, sized, unpacked
from middleware.entangled.errors import Forged, Malformed
from middleware.entangled.identity import Identity, verified

ROOM = 640
"""Bytes that a pass may have."""
SKEW = 300
"""Seconds by which two clocks of one team may differ."""
BOOTSTRAP = "bootstrap"
GATEWAY = "gateway"
ADMISSION = 9
"""The kind of an admission among the entries of the membership list, beside those of statements."""
GUEST_LIFE = 86_400
"""Seconds for which a gateway vouches for a guest at most."""
_GUEST = b"swarm-guest-1 "
_JOIN = b"swarm-join-1 "
_ADMIT = b"swarm-admit-1 "
_RENEW = b"swarm-renew-1 "


@dataclass(frozen=True)
class Member:
    """What a pass says of who holds ``public``.

    ``invitation`` is the public key of that by which it came, good for ``uses`` newcomers, ``admitter`` that of the
    bootstrap node; both are empty where the operator named the member itself.  ``voucher`` is the member that vouches
    for a guest.

    ``since`` and ``life`` are those of the operator's word: the moment from which it holds, and the seconds for which
    the certificate was made.  ``renewer`` is the bootstrap node that renewed it; empty where none did.
    """

    public: bytes
    name: str
    roles: tuple[str, ...]
    not_before: int
    not_after: int
    invitation: bytes = b""
    admitter: bytes = b""
    voucher: Member | None = None
    uses: int = 0
    since: int = 0
    life: int = 0
    renewer: bytes = b""

    @property
    def is_renewable(self) -> bool:
        """Whether bootstrap nodes may renew it: guests and shorter certificates end."""
        return self.life >= YEAR and self.voucher is None

    @property
    def unrenewed(self) -> Member:
        """The member by its certificate before any renewal.

        The renewal of a member that came by a code does not say when that certificate ended: it counts as over.
        """
        if not self.renewer:
            return self
        end = self.since if self.invitation else self.since + self.life
        return replace(self, not_before=self.since, not_after=end, renewer=b"")

    def trouble(self, now: float) -> str:
        """``early`` or ``expired``, or nothing where the pass is valid at that moment of the wall clock."""
        if now < self.not_before - SKEW:
            return "early"
        return "expired" if now >= self.not_after else ""


def pass_of(grant: bytes) -> bytes:
    """The pass of who got a grant of the operator's own."""
    return bytes(msgpack.packb([0, grant]))


def proof(invitation: Identity, public: bytes, wish: str) -> bytes:
    """The signature by which whoever has the code brings in the key ``public``."""
    return invitation.sign(_wished(public, wish))


def is_proof(invitation: bytes, public: bytes, wish: str, signature: bytes) -> bool:
    """Whether the holder of an invitation's key brings in ``public``."""
    return verified(invitation, _wished(public, wish), signature)


def chained(
    bootstrap: Identity,
    grant: bytes,
    invite: tuple[bytes, Invite],
    newcomer: tuple[bytes, str, bytes],
    name: str,
    now: int,
) -> bytes:
    """The pass that a bootstrap node makes: ``invite`` as packed and as read, ``newcomer`` its key, wish and proof."""
    packed, terms = invite
    public, wish, signature = newcomer
    end = now + terms.life
    admission = bootstrap.sign(_admitted(terms.public, public, name, now, end))
    return bytes(msgpack.packb([1, packed, wish, signature, name, now, end, admission, grant]))


def renewed(bootstrap: Identity, grant: bytes, member: Member, shown: bytes, now: int) -> bytes:
    """Renew the pass ``shown`` of ``member``, which it says, from ``now`` on for as long as the operator made it.

    ``grant`` is that of ``bootstrap``.  Raises ``Malformed`` for the pass of a guest.
    """
    word, end = _word_of(member, shown), now + member.life
    signature = bootstrap.sign(_renewed(member.public, word, now, end))
    return bytes(msgpack.packb([3, word, now, end, signature, grant]))


def _word_of(member: Member, shown: bytes) -> list[Any]:
    """The operator's word in a pass that says ``member``."""
    kind, *rest = unpacked(shown)
    if kind == 0:
        return [rest[0]]
    if kind == 1:
        invite, wish, signature, name, *_ = rest
        return [invite, wish, signature, name, member.admitter]
    if kind == 3:
        return list(rest[0])
    raise Malformed("the pass of a guest is not renewed")


def grant_of(operator: bytes, shown: bytes) -> tuple[Grant, bytes] | None:
    """Return the operator's grant that a renewed pass has in it, and it as packed; None where it came by a code."""
    word = unpacked(shown)[1]
    return (_grant(operator, word[0]), word[0]) if len(word) == 1 else None


def entries_of(public: bytes, shown: bytes) -> list[bytes]:
    """Return the entries of the membership list that a good pass of ``public`` has in it; none for that of a guest."""
    kind, *rest = unpacked(shown)
    if kind == 0:
        return [bytes(rest[0])]
    grants = [bytes(rest[0][0])] if kind == 3 and len(rest[0]) == 1 else []
    return [*grants, bytes(msgpack.packb([ADMISSION, public, shown]))] if kind in (1, 3) else []


def guest_pass(gateway: Identity, own: bytes, public: bytes, name: str, now: int, life: int = GUEST_LIFE) -> bytes:
    """The pass of a guest, made by the ``gateway`` whose ``own`` pass that is.

    Raises ``Malformed`` where that one is too long to stand in another: its operator has to grant it one (swarm
    promote).
    """
    end = now + min(life, GUEST_LIFE)
    signature = gateway.sign(_vouched(public, name, now, end))
    shown = bytes(msgpack.packb([2, name, now, end, signature, gateway.public, own]))
    if len(shown) > ROOM:
        raise Malformed("the pass of this gateway is too long to vouch for others; have the operator grant it one")
    return shown


def member_of(operator: bytes, public: bytes, shown: bytes) -> Member:
    """What the pass says of ``public``, if it goes back to that operator; raises ``Malformed`` or ``Forged``.

    Whether it is the time for it, and whether anything of it was revoked, is for the caller to look after.
    """
    if len(shown) > ROOM:
        raise Malformed("a pass that is too long")
    fields = unpacked(shown)
    try:
        kind, *rest = fields
        if kind == 0:
            [whole] = rest
            return member_by(_own_grant(operator, public, whole))
        if kind == 1:
            return _chain(operator, public, rest)
        if kind == 2:
            return _guest(operator, public, rest)
        if kind == 3:
            return _renewal(operator, public, rest)
    except (ValueError, TypeError) as error:
        raise Malformed("a pass with other fields than it should have") from error
    raise Malformed("a pass of no known kind")


def member_by(grant: Grant) -> Member:
    """The member that the operator's ``grant`` makes."""
    begin, end = grant.not_before, grant.not_after
    return Member(grant.public, grant.name, grant.roles, begin, end, since=begin, life=grant.life)


def _renewal(operator: bytes, public: bytes, fields: list[Any]) -> Member:
    word, begin, end, signature, whole = fields
    if not isinstance(word, list):
        raise Malformed("a renewal without the operator's word")
    member = member_by(_own_grant(operator, public, word[0])) if len(word) == 1 else _invited(operator, public, word)
    if not member.is_renewable:
        raise Forged("a certificate that the operator did not make to be renewed")
    grant = _grant(operator, whole)
    if BOOTSTRAP not in grant.roles or grant.life < YEAR:
        raise Forged("a renewal by a node that may not renew")
    moment(begin, max(0, max(member.since, grant.not_before) - SKEW))
    moment(end, begin + 1, begin + member.life)
    if not verified(grant.public, _renewed(public, word, begin, end), sized(signature, 64)):
        raise Forged("a renewal that no bootstrap node signed")
    return replace(member, not_before=begin, not_after=end, renewer=grant.public)


def _invited(operator: bytes, public: bytes, word: list[Any]) -> Member:
    """The member that came by a code, with no dates; the name has to be one that the invitation and the wish allow."""
    packed, wish, signature, name, admitter = word
    invite = _invitation(operator, public, packed, wish, signature)
    if not invite.allows(named(name), wish):
        raise Forged("a name that the invitation does not give")
    since = max(0, invite.not_before - SKEW)
    origin = invite.public, sized(admitter, 32)
    return Member(public, name, invite.roles, 0, 0, *origin, uses=invite.uses, since=since, life=invite.life)


def _invitation(operator: bytes, public: bytes, packed: Any, wish: Any, signature: Any) -> Invite:
    """The invitation whose holder brings in the key ``public`` under the name ``wish``."""
    invite = opened(operator, packed)
    if not isinstance(invite, Invite):
        raise Malformed("a chain begins with an invitation")
    if wish != "":
        named(wish)
    if not is_proof(invite.public, public, wish, sized(signature, 64)):
        raise Forged("the invitation does not stand for this key")
    return invite


def _chain(operator: bytes, public: bytes, fields: list[Any]) -> Member:
    packed, wish, signature, name, begin, end, admission, whole = fields
    invite = _invitation(operator, public, packed, wish, signature)
    moment(begin, max(0, invite.not_before - SKEW), invite.not_after)
    moment(end, begin + 1, begin + invite.life)
    grant = _grant(operator, whole)
    # A bootstrap node that is renewed outlives its grant, which goes on to say what it may do until it is revoked.
    is_over = begin >= grant.not_after and grant.life < YEAR
    if BOOTSTRAP not in grant.roles or begin < grant.not_before - SKEW or is_over:
        raise Forged("who let this key in was no bootstrap node then")
    if not verified(grant.public, _admitted(invite.public, public, named(name), begin, end), sized(admission, 64)):
        raise Forged("no bootstrap node let this key in")
    origin = invite.public, grant.public
    return Member(public, name, invite.roles, begin, end, *origin, uses=invite.uses, since=begin, life=invite.life)


def _guest(operator: bytes, public: bytes, fields: list[Any]) -> Member:
    name, begin, end, signature, gateway, own = fields
    if not isinstance(own, bytes):
        raise Malformed("a guest wants somebody's pass")
    voucher = member_of(operator, sized(gateway, 32), own)
    moment(begin)
    moment(end, begin + 1, begin + GUEST_LIFE)
    if voucher.voucher is not None:
        raise Forged("a guest vouches for nobody")
    if not verified(voucher.public, _vouched(public, named(name), begin, end), sized(signature, 64)):
        raise Forged("nobody vouches for this key")
    return Member(public, name, ("device",), begin, end, voucher=voucher)


def _vouched(public: bytes, name: str, begin: int, end: int) -> bytes:
    return _GUEST + bytes(msgpack.packb([public, name, begin, end]))


def _grant(operator: bytes, whole: Any) -> Grant:
    grant = opened(operator, whole)
    if not isinstance(grant, Grant):
        raise Malformed("a pass wants a grant")
    return grant


def _own_grant(operator: bytes, public: bytes, whole: Any) -> Grant:
    grant = _grant(operator, whole)
    if grant.public != public:
        raise Forged("a grant of somebody else")
    return grant


def _wished(public: bytes, wish: str) -> bytes:
    return _JOIN + public + wish.encode()


def _admitted(invitation: bytes, public: bytes, name: str, begin: int, end: int) -> bytes:
    return _ADMIT + bytes(msgpack.packb([invitation, public, name, begin, end]))


def _renewed(public: bytes, word: list[Any], begin: int, end: int) -> bytes:
    return _RENEW + bytes(msgpack.packb([public, word, begin, end]))
