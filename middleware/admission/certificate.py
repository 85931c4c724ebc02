"""Certificates of members: formats, creation and verification.

A node sends its certificate in the handshake of a session.  A certificate is one msgpack array of at most
``MAX_CERTIFICATE_BYTES`` bytes, in one of four formats:

* ``[0, grant]``: the operator's grant.
* ``[1, invite, wish, proof, name, not before, not after, signature, grant]``: an admission by invitation.  ``proof`` is
  the invitation's signature over the newcomer's key and the name that the newcomer requested.  ``signature`` is the
  signature of the bootstrap node, and ``grant`` is the operator's grant to that node with the role ``bootstrap``.  So
  neither a bootstrap node alone nor the holder of a leaked code alone can admit a member.  * ``[2, name, not before,
  not after, signature, gateway, pass]``: a guest, such as a visitor's phone.  A member with the role ``gateway`` signs
  the certificate of the guest, for at most a day.  This certificate becomes invalid when the gateway's own certificate
  ``pass`` becomes invalid.  * ``[3, content, not before, not after, signature, grant]``: a renewal of format 0 or 1.
  ``content`` has the fields that the operator signed, ``[grant]`` or ``[invite, wish, proof, name, admitter]``; the
  bootstrap node adds its ``signature`` and its ``grant``.  The name and the roles are in ``content``, so a renewal
  changes only the dates.  Only certificates that the operator issued for ``DEFAULT_LIFE_S`` or longer are renewed, and
  only by bootstrap nodes that have such a certificate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import msgpack

from middleware.admission.statement import (
    DEFAULT_LIFE_S,
    Grant,
    Invite,
    check_bytes,
    check_name,
    check_number,
    open_statement,
    unpack_fields,
)
from middleware.entangled.errors import Forged, Malformed
from middleware.entangled.identity import Identity, is_signature_valid

MAX_CERTIFICATE_BYTES = 640
"""Maximum size of a certificate in bytes."""
MAX_CLOCK_SKEW_S = 300
"""Maximum clock difference within a team, in seconds."""
BOOTSTRAP = "bootstrap"
GATEWAY = "gateway"
ADMISSION_KIND = 9
"""Entry kind of admissions on the membership list, next to the kinds of statements."""
GUEST_LIFE_S = 86_400
"""Maximum validity of a guest's certificate, in seconds."""
_GUEST = b"swarm-guest-1 "
_JOIN = b"swarm-join-1 "
_ADMIT = b"swarm-admit-1 "
_RENEW = b"swarm-renew-1 "


@dataclass(frozen=True)
class Member:
    """A member as described by its certificate; ``public`` is its key.

    ``invitation`` is the public key of the invitation by which the member joined, valid for ``uses`` newcomers, and
    ``admitter`` is the public key of the bootstrap node; both are empty if the operator granted the certificate
    directly.  ``gateway`` is the gateway that signed the certificate of a guest.

    ``since`` is the time from which the content that the operator signed is valid, and ``life`` the number of seconds
    for which the certificate was issued.  ``renewer`` is the key of the bootstrap node that renewed the certificate, or
    empty.
    """

    public: bytes
    name: str
    roles: tuple[str, ...]
    not_before: int
    not_after: int
    invitation: bytes = b""
    admitter: bytes = b""
    gateway: Member | None = None
    uses: int = 0
    since: int = 0
    life: int = 0
    renewer: bytes = b""

    @property
    def is_renewable(self) -> bool:
        """Whether bootstrap nodes may renew the certificate; guests' and short-lived certificates expire."""
        return self.life >= DEFAULT_LIFE_S and self.gateway is None

    @property
    def before_renewal(self) -> Member:
        """The member with the dates of its certificate before any renewal.

        The renewal of a member that joined by a code does not contain the original end date; the certificate is then
        treated as expired.
        """
        if not self.renewer:
            return self
        end = self.since if self.invitation else self.since + self.life
        return replace(self, not_before=self.since, not_after=end, renewer=b"")

    def check_dates(self, now: float) -> str:
        """Return ``early`` or ``expired``, or an empty string if the certificate is valid at ``now`` (wall clock)."""
        if now < self.not_before - MAX_CLOCK_SKEW_S:
            return "early"
        return "expired" if now >= self.not_after else ""


def wrap_grant(grant: bytes) -> bytes:
    """Return the certificate of a member that consists of the operator's ``grant``."""
    return bytes(msgpack.packb([0, grant]))


def sign_join(invitation: Identity, public: bytes, requested_name: str) -> bytes:
    """Sign, with the invitation's key, the newcomer's key ``public`` and the name that the newcomer requests."""
    return invitation.sign(_join_content(public, requested_name))


def is_join_signature(invitation: bytes, public: bytes, requested_name: str, signature: bytes) -> bool:
    """Return whether the invitation's key signed ``public`` and ``requested_name``."""
    return is_signature_valid(invitation, _join_content(public, requested_name), signature)


def issue_certificate(
    bootstrap: Identity,
    grant: bytes,
    invite: tuple[bytes, Invite],
    applicant: tuple[bytes, str, bytes],
    name: str,
    now: int,
) -> bytes:
    """Return the certificate that a bootstrap node issues to a newcomer.

    ``invite`` is the invitation, packed and parsed.  ``applicant`` contains the newcomer's key, the requested name and
    the proof.
    """
    packed, terms = invite
    public, requested_name, signature = applicant
    end = now + terms.life
    admission = bootstrap.sign(_admission_content(terms.public, public, name, now, end))
    return bytes(msgpack.packb([1, packed, requested_name, signature, name, now, end, admission, grant]))


def renew_certificate(bootstrap: Identity, grant: bytes, member: Member, certificate: bytes, now: int) -> bytes:
    """Renew the certificate of ``member`` from ``now`` on, with its original validity.

    ``grant`` is the grant of ``bootstrap``.  Raises ``Malformed`` for the certificate of a guest.
    """
    content, end = _extract_signed_content(member, certificate), now + member.life
    signature = bootstrap.sign(_renewal_content(member.public, content, now, end))
    return bytes(msgpack.packb([3, content, now, end, signature, grant]))


def _extract_signed_content(member: Member, certificate: bytes) -> list[Any]:
    """Return the content that the operator signed in the certificate of ``member``."""
    kind, *rest = unpack_fields(certificate)
    if kind == 0:
        return [rest[0]]
    if kind == 1:
        invite, requested_name, signature, name, *_ = rest
        return [invite, requested_name, signature, name, member.admitter]
    if kind == 3:
        return list(rest[0])
    raise Malformed("the certificate of a guest cannot be renewed")


def extract_grant(operator: bytes, certificate: bytes) -> tuple[Grant, bytes] | None:
    """Return the operator's grant in a renewed certificate, parsed and packed; None if the member joined by a code."""
    content = unpack_fields(certificate)[1]
    return (_parse_grant(operator, content[0]), content[0]) if len(content) == 1 else None


def extract_entries(public: bytes, certificate: bytes) -> list[bytes]:
    """Return the entries for the membership list in a valid certificate of ``public``; none for a guest."""
    kind, *rest = unpack_fields(certificate)
    if kind == 0:
        return [bytes(rest[0])]
    grants = [bytes(rest[0][0])] if kind == 3 and len(rest[0]) == 1 else []
    return [*grants, bytes(msgpack.packb([ADMISSION_KIND, public, certificate]))] if kind in (1, 3) else []


def issue_guest_certificate(
    gateway: Identity, own: bytes, public: bytes, name: str, now: int, life: int = GUEST_LIFE_S
) -> bytes:
    """Return a guest's certificate, signed by ``gateway``; ``own`` is the gateway's own certificate.

    Raises ``Malformed`` if ``own`` is too long to be embedded; the operator then has to issue a grant (swarm promote).
    """
    end = now + min(life, GUEST_LIFE_S)
    signature = gateway.sign(_guest_content(public, name, now, end))
    certificate = bytes(msgpack.packb([2, name, now, end, signature, gateway.public, own]))
    if len(certificate) > MAX_CERTIFICATE_BYTES:
        raise Malformed("the certificate of this gateway is too long for guests; run swarm promote for the gateway")
    return certificate


def verify_certificate(operator: bytes, public: bytes, certificate: bytes) -> Member:
    """Verify a certificate of ``public`` with the ``operator``'s key; raise ``Malformed`` or ``Forged``.

    The caller checks dates and revocations.
    """
    if len(certificate) > MAX_CERTIFICATE_BYTES:
        raise Malformed(f"the certificate has {len(certificate)} bytes; at most {MAX_CERTIFICATE_BYTES} are allowed")
    fields = unpack_fields(certificate)
    try:
        kind, *rest = fields
        if kind == 0:
            [packed_grant] = rest
            return make_member(_parse_own_grant(operator, public, packed_grant))
        if kind == 1:
            return _verify_admission(operator, public, rest)
        if kind == 2:
            return _verify_guest(operator, public, rest)
        if kind == 3:
            return _verify_renewal(operator, public, rest)
    except (ValueError, TypeError) as error:
        raise Malformed("the certificate has invalid fields") from error
    raise Malformed("the certificate is of an unknown kind")


def make_member(grant: Grant) -> Member:
    """Return the member described by the operator's ``grant``."""
    begin, end = grant.not_before, grant.not_after
    return Member(grant.public, grant.name, grant.roles, begin, end, since=begin, life=grant.life)


def _verify_renewal(operator: bytes, public: bytes, fields: list[Any]) -> Member:
    content, begin, end, signature, packed_grant = fields
    if not isinstance(content, list):
        raise Malformed("the renewal contains nothing that the operator signed")
    member = (
        make_member(_parse_own_grant(operator, public, content[0]))
        if len(content) == 1
        else _verify_invited(operator, public, content)
    )
    if not member.is_renewable:
        raise Forged("the operator did not issue this certificate as renewable")
    grant = _parse_grant(operator, packed_grant)
    if BOOTSTRAP not in grant.roles or grant.life < DEFAULT_LIFE_S:
        raise Forged("the renewal is signed by a node that may not renew certificates")
    check_number(begin, max(0, max(member.since, grant.not_before) - MAX_CLOCK_SKEW_S))
    check_number(end, begin + 1, begin + member.life)
    if not is_signature_valid(grant.public, _renewal_content(public, content, begin, end), check_bytes(signature, 64)):
        raise Forged("the renewal's signature is not valid")
    return replace(member, not_before=begin, not_after=end, renewer=grant.public)


def _verify_invited(operator: bytes, public: bytes, content: list[Any]) -> Member:
    """Return the member that joined by a code, without dates."""
    packed, requested_name, signature, name, admitter = content
    invite = _verify_invitation(operator, public, packed, requested_name, signature, name)
    since = max(0, invite.not_before - MAX_CLOCK_SKEW_S)
    origin = invite.public, check_bytes(admitter, 32)
    return Member(public, name, invite.roles, 0, 0, *origin, uses=invite.uses, since=since, life=invite.life)


def _verify_invitation(
    operator: bytes, public: bytes, packed: Any, requested_name: Any, signature: Any, name: Any
) -> Invite:
    """Return the invitation by which ``public`` joined with ``name``, after verification."""
    invite = open_statement(operator, packed)
    if not isinstance(invite, Invite):
        raise Malformed("the certificate does not begin with an invitation")
    if requested_name != "":
        check_name(requested_name)
    if not is_join_signature(invite.public, public, requested_name, check_bytes(signature, 64)):
        raise Forged("the invitation's signature does not cover this key")
    if not invite.allows(check_name(name), requested_name):
        raise Forged("the invitation does not allow this name")
    return invite


def _verify_admission(operator: bytes, public: bytes, fields: list[Any]) -> Member:
    packed, requested_name, signature, name, begin, end, admission, packed_grant = fields
    invite = _verify_invitation(operator, public, packed, requested_name, signature, name)
    check_number(begin, max(0, invite.not_before - MAX_CLOCK_SKEW_S), invite.not_after)
    check_number(end, begin + 1, begin + invite.life)
    grant = _parse_grant(operator, packed_grant)
    # A renewed bootstrap node may be used after the end of its grant; its roles are valid until it is revoked.
    is_over = begin >= grant.not_after and grant.life < DEFAULT_LIFE_S
    if BOOTSTRAP not in grant.roles or begin < grant.not_before - MAX_CLOCK_SKEW_S or is_over:
        raise Forged("the node that admitted this key was not a bootstrap node at that time")
    content = _admission_content(invite.public, public, name, begin, end)
    if not is_signature_valid(grant.public, content, check_bytes(admission, 64)):
        raise Forged("the bootstrap node's signature is not valid")
    origin = invite.public, grant.public
    return Member(public, name, invite.roles, begin, end, *origin, uses=invite.uses, since=begin, life=invite.life)


def _verify_guest(operator: bytes, public: bytes, fields: list[Any]) -> Member:
    name, begin, end, signature, gateway_key, own = fields
    if not isinstance(own, bytes):
        raise Malformed("the guest's certificate does not contain that of a gateway")
    gateway = verify_certificate(operator, check_bytes(gateway_key, 32), own)
    check_number(begin)
    check_number(end, begin + 1, begin + GUEST_LIFE_S)
    if gateway.gateway is not None:
        raise Forged("a guest cannot sign the certificate of another guest")
    if not is_signature_valid(
        gateway.public, _guest_content(public, check_name(name), begin, end), check_bytes(signature, 64)
    ):
        raise Forged("the gateway's signature is not valid")
    return Member(public, name, ("device",), begin, end, gateway=gateway)


def _guest_content(public: bytes, name: str, begin: int, end: int) -> bytes:
    return _GUEST + bytes(msgpack.packb([public, name, begin, end]))


def _parse_grant(operator: bytes, packed_grant: Any) -> Grant:
    grant = open_statement(operator, packed_grant)
    if not isinstance(grant, Grant):
        raise Malformed("the certificate does not contain a grant")
    return grant


def _parse_own_grant(operator: bytes, public: bytes, packed_grant: Any) -> Grant:
    grant = _parse_grant(operator, packed_grant)
    if grant.public != public:
        raise Forged("the grant is for a different key")
    return grant


def _join_content(public: bytes, requested_name: str) -> bytes:
    return _JOIN + public + requested_name.encode()


def _admission_content(invitation: bytes, public: bytes, name: str, begin: int, end: int) -> bytes:
    return _ADMIT + bytes(msgpack.packb([invitation, public, name, begin, end]))


def _renewal_content(public: bytes, content: list[Any], begin: int, end: int) -> bytes:
    return _RENEW + bytes(msgpack.packb([public, content, begin, end]))
