"""Admission check of a closed team: verify certificates with the membership list.

The module ``roles`` defines the permissions of each role.
"""

from __future__ import annotations

import hashlib
import random
from collections import OrderedDict
from collections.abc import Callable

from middleware.admission import roles
from middleware.admission.certificate import (
    MAX_CERTIFICATE_BYTES,
    Member,
    extract_entries,
    make_member,
    verify_certificate,
    wrap_grant,
)
from middleware.admission.membership_file import Membership
from middleware.admission.membership_list import MembershipList
from middleware.entangled.data.store import Store
from middleware.entangled.errors import Full, RemoteError
from middleware.entangled.record import Slot
from middleware.entangled.wire.admission_check import (
    FOREIGN,
    NONCE_BYTES,
    REVOKED,
    UNLISTED,
    Authority,
    Incarnation,
    next_incarnation,
)

MAX_SESSION_MEMBERS = 4096
MAX_CACHED_CERTIFICATES = 1024
MAX_GUESTS_PER_GATEWAY = 64
"""Maximum number of guests of one gateway that a node accepts at a time."""
AUTHORITY_CACHE_S = 1.0
"""Seconds for which an owner's authority is cached, unless the membership list changes."""
INCARNATION_NOTE = "admission/life"
"""Name of the stored note with the number of the node's last incarnation."""


def start_incarnation(store: Store, wall: float, rng: random.Random) -> Incarnation:
    """Start a new incarnation with a higher number than the last one, and store the number in ``store``."""
    try:
        last = int(store.get_note(INCARNATION_NOTE) or b"0")
    except ValueError:  # damaged file
        last = 0
    # The time is in milliseconds, because a guest can leave and return within a second, and stores nothing in between.
    number = next_incarnation(max(0, last), wall * 1000.0)
    store.set_note(INCARNATION_NOTE, b"%d" % number)
    return Incarnation(number, rng.randbytes(NONCE_BYTES))


class ClosedAdmission:
    """Verifies certificates with ``membership_list``; implements ``AdmissionCheck``.

    ``membership`` returns this node's own membership.  Verified certificates are cached by digest, so the signatures of
    each certificate are checked only once.
    """

    max_pass_bytes = MAX_CERTIFICATE_BYTES

    def __init__(
        self,
        membership_list: MembershipList,
        membership: Callable[[], Membership],
        wall: Callable[[], float],
        incarnation: Incarnation,
    ) -> None:
        self.incarnation = incarnation
        self.fingerprint = hashlib.blake2s(membership_list.operator, digest_size=8, person=b"team").digest()
        self._membership_list = membership_list
        self._membership = membership
        self._wall = wall
        self._own_member = membership().member
        self.publish_entry: Callable[[bytes], object] = lambda packed: membership_list.add(packed, wall())
        self._verified: OrderedDict[bytes, Member] = OrderedDict()
        self._session_members: OrderedDict[bytes, Member] = OrderedDict()
        self._unlisted_certificates: dict[
            bytes, bytes
        ] = {}  # certificates of the members in ``_session_members`` that are not on the membership list
        self._authorities: dict[bytes, Authority] = {}
        self._cached_at = (b"", 0.0)

    @property
    def me(self) -> Member:
        """This node as a member of its team."""
        return self._membership_list.update_member(self._own_member, self._wall())

    @property
    def own_pass(self) -> bytes:
        """This node's certificate: the operator's latest grant, or its admission, with the latest renewal."""
        return self._membership_list.find_best_certificate(
            self._own_member, self._membership().certificate, self._wall()
        )

    def find_refusal(self, public: bytes, peer_pass: bytes) -> str:
        """Return the refusal for a node with key ``public`` and certificate ``peer_pass``; empty if it is accepted."""
        try:
            member = self._verify_certificate(public, peer_pass)
        except RemoteError:
            return FOREIGN
        now = self._wall()
        return self._membership_list.find_refusal(
            self._membership_list.update_member(member, now), now
        ) or self._check_guest_quota(member)

    def admit(self, public: bytes, peer_pass: bytes) -> str:
        """Check a node that has confirmed its session, and remember the node if it is accepted."""
        refusal = self.find_refusal(public, peer_pass)
        if not refusal:
            member = self._verify_certificate(public, peer_pass)
            refusal = self._add_to_list(public, peer_pass, member)
        if not refusal:
            self._session_members[public] = member
            self._session_members.move_to_end(public)
            self._authorities.pop(public, None)
            if self.is_unlisted(public):
                self._unlisted_certificates[public] = peer_pass
            if len(self._session_members) > MAX_SESSION_MEMBERS:
                self._unlisted_certificates.pop(self._session_members.popitem(last=False)[0], None)
        return refusal

    def may_call(self, public: bytes, method: str) -> bool:
        """Return whether ``public`` is the key of a current member that may call ``method``."""
        authority = self.find_authority(public)
        return not authority.refusal and roles.may_call(authority.roles, method)

    def roles_of(self, public: bytes) -> frozenset[str]:
        """Return the current roles of a key; none for strangers and for revoked or expired members."""
        return frozenset(self.find_authority(public).roles)

    def _add_to_list(self, public: bytes, peer_pass: bytes, member: Member) -> str:
        """Add a member to the membership list, so that all nodes know it and the operator can revoke it by name.

        Returns a refusal if the list is full, because only listed keys are members.  Guests are not listed, but their
        gateway is.  Renewals that are not on the list yet are also added.
        """
        entries = extract_entries(public, peer_pass) if member.gateway is None else []
        is_off_roll = self.is_unlisted(public)
        if public != self._own_member.public and (is_off_roll or member.renewer):
            try:
                for entry in entries:
                    if not self._membership_list.has(entry):
                        self.publish_entry(entry)
            except (Full, RemoteError):
                return UNLISTED if is_off_roll else ""
        return ""

    def _check_guest_quota(self, member: Member) -> str:
        """Return a refusal if the guest's gateway already has the maximum number of other guests here."""
        if member.gateway is None:
            return ""
        now, gateway = self._wall(), member.gateway.public
        others = sum(
            each.gateway is not None
            and each.gateway.public == gateway
            and each.public != member.public
            and not each.check_dates(now)
            for each in self._session_members.values()
        )
        return "" if others < MAX_GUESTS_PER_GATEWAY else UNLISTED

    def may_store(self, slot: Slot) -> bool:
        """Return whether the current certificate of the owner of ``slot`` permits writing there."""
        authority = self.find_authority(slot.owner)
        return not authority.refusal and roles.may_store(authority.roles, slot, authority.name)

    def may_keep(self, slot: Slot) -> bool:
        """Return whether a stored record in ``slot`` may be kept and returned to readers."""
        return self.may_store(slot) or (self.find_authority(slot.owner).refusal != FOREIGN and roles.is_lasting(slot))

    def find_authority(self, owner: bytes) -> Authority:
        """Return whether the certificate of an owner of records is valid now, with its roles and name."""
        now = self._wall()
        digest, at = self._cached_at
        if digest != self._membership_list.digest or not 0.0 <= now - at < AUTHORITY_CACHE_S:
            self._authorities.clear()
            self._cached_at = (self._membership_list.digest, now)
        found = self._authorities.get(owner)
        if found is None:
            found = self._authorities[owner] = self._compute_authority(owner, now)
            if len(self._authorities) > MAX_SESSION_MEMBERS:
                del self._authorities[next(iter(self._authorities))]
        return found

    def find_certificate(self, owner: bytes) -> bytes:
        """Return an owner's certificate: the latest grant, or the certificate that the owner sent; empty if unknown."""
        if owner == self._own_member.public:
            return self.own_pass
        now, grant, admission = (
            self._wall(),
            self._membership_list.find_grant(owner),
            self._membership_list.find_admission(owner),
        )
        if admission is not None:
            return self._membership_list.find_best_certificate(admission.member, admission.certificate, now)
        if grant is not None:
            return self._membership_list.find_best_certificate(make_member(grant[0]), wrap_grant(grant[1]), now)
        renewal = self._membership_list.find_renewal(owner)
        return self._unlisted_certificates.get(owner, b"") if renewal is None else renewal.certificate

    def is_unlisted(self, public: bytes) -> bool:
        """Return whether the membership list has no entry for ``public``: a guest, or a member not listed yet."""
        known = (
            self._membership_list.find_grant(public),
            self._membership_list.find_admission(public),
            self._membership_list.find_renewal(public),
        )
        return known == (None, None, None)

    def add_certificate(self, owner: bytes, certificate: bytes) -> bool:
        """Accept an owner's certificate that another node relayed; return whether it is valid."""
        return not self.admit(owner, certificate)

    def find_member(self, public: bytes) -> Member | None:
        """Return the known member with key ``public``, from a session or from the membership list."""
        if public == self._own_member.public:
            return self.me
        members, now = self._session_members.get(public), self._wall()
        return (
            self._membership_list.find_member(public, now)
            if members is None
            else self._membership_list.update_member(members, now)
        )

    def remove_former_members(self) -> list[tuple[bytes, str]]:
        """Remove nodes with sessions that are no longer members; return each with its refusal."""
        now = self._wall()
        gone = [
            (public, refusal)
            for public, member in self._session_members.items()
            if (refusal := self._membership_list.find_refusal(self._membership_list.update_member(member, now), now))
        ]
        for public, _ in gone:
            del self._session_members[public]
            self._unlisted_certificates.pop(public, None)
        return gone

    def _compute_authority(self, owner: bytes, now: float) -> Authority:
        if self._membership_list.find_revocation(owner) is not None:
            return Authority(REVOKED)
        member = self.find_member(owner)
        if member is None:
            return Authority(FOREIGN)
        refusal = self._membership_list.find_refusal(member, now)
        return Authority(refusal) if refusal else Authority("", member.roles, member.name)

    def _verify_certificate(self, public: bytes, peer_pass: bytes) -> Member:
        key = hashlib.blake2s(public + peer_pass, digest_size=16).digest()
        member = self._verified.get(key)
        if member is None:
            member = self._verified[key] = verify_certificate(self._membership_list.operator, public, peer_pass)
            if len(self._verified) > MAX_CACHED_CERTIFICATES:
                self._verified.popitem(last=False)
        else:
            self._verified.move_to_end(key)
        return member
