"""Membership list of a closed team: the operator's statements and the admissions that a node knows.

Entries are only added, until they expire, so the list is a grow-only set: two nodes with the same statements have the
same state, in whatever order the statements arrived.  Of two statements about the same subject, the later one is valid,
and the other is dropped.  The list also contains admissions: the key of a newcomer with the certificate that a
bootstrap node issued.  With these, names stay unique, a newcomer gets the same reply from every bootstrap node, and the
operator can list the members.  The list also contains the newest renewal of each key, which changes only the end date
of its grant or admission.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import msgpack

from middleware.admission.certificate import (
    ADMISSION_KIND,
    BOOTSTRAP,
    GATEWAY,
    MAX_CLOCK_SKEW_S,
    Member,
    extract_grant,
    make_member,
    verify_certificate,
    wrap_grant,
)
from middleware.admission.statement import (
    DEFAULT_LIFE_S,
    Entry,
    Grant,
    Invite,
    Revocation,
    Secret,
    Terms,
    check_bytes,
    compute_retention_end,
    member_id,
    open_statement,
    renewal_id,
    unpack_fields,
)
from middleware.entangled.errors import Full, Malformed

MAX_ENTRIES = 4096
MAX_BYTES = 2**20
RESERVED_ENTRIES, RESERVED_BYTES = 1024, 2**18
"""The share of the limits that is reserved for statements of the operator; bootstrap nodes sign admissions."""
MAX_SECRETS = 4
"""Number of team secrets that are kept, newest first."""
MIN_RENEWAL_S = 7 * 86_400
"""Minimum seconds that a renewal adds; also the maximum gap between end dates of bootstrap nodes before a renewal."""
DIGEST_BYTES = 8
INVITATION_ID_BYTES = 8


@dataclass(frozen=True)
class SignedCertificate(Entry):
    """The certificate of a member, signed by a bootstrap node."""

    member: Member
    certificate: bytes

    @property
    def slot(self) -> tuple[str, bytes]:
        """The kind of the entry and the member's key."""
        return self.kind, self.member.public

    @property
    def kept_until(self) -> int:
        """The time from which the operator can no longer renew the certificate."""
        return compute_retention_end(self.member.not_after, self.member.life)


@dataclass(frozen=True)
class Admission(SignedCertificate):
    """A newcomer that a bootstrap node admitted."""

    kind = "admission"

    @property
    def rank(self) -> int:
        """The sort key: the later admission is valid."""
        return self.member.not_before


@dataclass(frozen=True)
class Renewal(SignedCertificate):
    """A member whose certificate a bootstrap node renewed.

    ``grant`` is the operator's grant, parsed and packed; None if the member joined by a code.
    """

    kind = "renewal"
    grant: tuple[Grant, bytes] | None

    @property
    def rank(self) -> int:
        """The sort key: the renewal that ends later is valid, so no bootstrap node can shorten a renewal."""
        return self.member.not_after


Kind = TypeVar("Kind", bound=Entry)


class StoredEntry(NamedTuple):
    """An entry, parsed and packed."""

    entry: Entry
    packed: bytes


def compute_digest(packed: bytes) -> bytes:
    """Return the digest that identifies an entry."""
    return hashlib.blake2s(packed, digest_size=DIGEST_BYTES).digest()


def invitation_id(public: bytes) -> bytes:
    """Return the id of an invitation, which a join request contains in clear text."""
    return hashlib.blake2s(public, digest_size=INVITATION_ID_BYTES, person=b"invite").digest()


def pack_admission(public: bytes, certificate: bytes) -> bytes:
    """Pack an admission or a renewal; the certificate in it is signed."""
    return bytes(msgpack.packb([ADMISSION_KIND, public, certificate]))


class MembershipList:
    """The membership list of the team with the operator key ``operator``; pure logic without a clock.

    ``now`` is in seconds of the wall clock.
    """

    def __init__(self, operator: bytes) -> None:
        self.operator = operator
        self._entries: dict[bytes, StoredEntry] = {}
        self._slots: dict[tuple[str, bytes], bytes] = {}
        self._by_id: dict[bytes, bytes] = {}
        self.invalidated: list[bytes] = []
        """Keys of the members whose admission the last revocation invalidated."""
        self._users: dict[bytes, Counter[bytes]] = {}  # for each invitation, the keys of the members that joined by it
        self._digest = 0
        self._bytes = 0

    def __len__(self) -> int:
        """Return the number of entries."""
        return len(self._entries)

    @property
    def digest(self) -> bytes:
        """Eight bytes that are equal at two nodes with the same entries."""
        return self._digest.to_bytes(DIGEST_BYTES)

    @property
    def digests(self) -> list[bytes]:
        """The digest of each entry."""
        return list(self._entries)

    def list_packed(self, wanted: Iterable[bytes] | None = None) -> list[bytes]:
        """Return the packed entries with those digests, or all."""
        keys = self._entries if wanted is None else wanted
        return [self._entries[key].packed for key in keys if key in self._entries]

    def has(self, packed: bytes) -> bool:
        """Return whether the list contains this entry."""
        return compute_digest(packed) in self._entries

    def add(self, packed: object, now: float) -> Entry | None:
        """Add an entry; return the entry if it is new and valid, else None.

        Raises ``Malformed`` or ``Forged`` for an entry that is not of this team, and ``Full`` if there is no room.
        """
        if not isinstance(packed, bytes):
            raise Malformed("an entry of the membership list has to be bytes")
        key = compute_digest(packed)
        if key in self._entries:
            return None
        entry = self._parse(packed)
        if entry.kept_until <= now or self._is_invalid(entry, now):
            return None
        before = self._slots.get(entry.slot)
        if before is not None and (entry.rank, packed) <= (
            self._entries[before].entry.rank,
            self._entries[before].packed,
        ):
            return None
        if before is not None:
            self._remove(before)
        if isinstance(entry, Secret) and not self._has_room_for_secret(entry):
            return None
        self._check_room(entry, packed, now)
        self._insert(key, StoredEntry(entry, packed))
        if isinstance(entry, Revocation) or (isinstance(entry, Grant) and before is not None):
            self._drop_invalid(self._entries, now)
        elif isinstance(entry, Grant):
            self._drop_invalid(
                [self._slots[slot] for slot in [(Renewal.kind, entry.public)] if slot in self._slots], now
            )
        return entry

    def expire(self, now: float) -> int:
        """Drop expired entries, and return their number."""
        gone = [key for key, held in self._entries.items() if held.entry.kept_until <= now]
        for key in gone:
            self._remove(key)
        return len(gone)

    # -- queries ----------------------------------------------------------------------------------------------------

    def find_revocation(self, public: bytes) -> Revocation | None:
        """Return the revocation of a member's or an invitation's key."""
        return self._find(Revocation, public)

    def find_grant(self, public: bytes) -> tuple[Grant, bytes] | None:
        """Return the operator's grant for ``public``, parsed and packed."""
        found, renewal = self._find_packed(Grant, public), self.find_renewal(public)
        other = None if renewal is None else renewal.grant
        if found is None or (other is not None and found[0].not_before < other[0].not_before):
            return other
        return found

    def find_invitation(self, name: bytes) -> tuple[Invite, bytes] | None:
        """Return the invitation with that id, parsed and packed."""
        return self._find_packed(Invite, self._by_id.get(name, b""))

    def find_terms(self, invitation: bytes) -> bytes | None:
        """Return the encrypted terms of the invitation with that public key; None if they are not known."""
        entry = self._find(Terms, invitation)
        return None if entry is None else entry.sealed

    def find_admission(self, public: bytes) -> Admission | None:
        """Return the admission of ``public``."""
        return self._find(Admission, public)

    def find_renewal(self, public: bytes) -> Renewal | None:
        """Return the newest renewal of the certificate of ``public``."""
        return self._find(Renewal, public)

    def list_secrets(self) -> list[Secret]:
        """Return the statements with the team's secrets, newest first."""
        return sorted(self._list_kind(Secret), key=lambda each: -each.number)

    def list_invitations(self) -> list[Invite]:
        """Return all known invitations, oldest first."""
        return sorted(self._list_kind(Invite), key=lambda each: each.not_before)

    def list_revocations(self) -> list[Revocation]:
        """Return all revocations."""
        return self._list_kind(Revocation)

    def list_admissions(self) -> list[Admission]:
        """Return all admissions by bootstrap nodes."""
        return self._list_kind(Admission)

    def find_refusal(self, member: Member, now: float) -> str:
        """Return ``revoked``, ``expired``, ``early`` or ``role`` for a key that is not a member; empty for a member."""
        if self.find_revocation(member.public) is not None or (
            member.invitation and self.find_revocation(member.invitation) is not None
        ):
            return "revoked"
        if member.admitter:
            # Dates prove nothing: the holder of a revoked bootstrap node's key can sign any date.
            end = self.find_revocation(member.admitter)
            if end is not None and member_id(member.public) not in end.kept:
                return "revoked"
        if member.gateway is not None:
            gateway = self.update_member(member.gateway, now)
            if GATEWAY not in gateway.roles:
                return "role"
            return self.find_refusal(gateway, now) or member.check_dates(now)
        return member.check_dates(now)

    def update_member(self, member: Member, now: float) -> Member:
        """Update ``member`` with the operator's latest grant and the renewal that ends last.

        A renewal applies only to the grant that it renews, and only if its signer may renew now.
        """
        found, renewals = member.before_renewal, [member] if member.renewer else []
        grant, held = self.find_grant(member.public), self.find_renewal(member.public)
        admission = self.find_admission(member.public)
        if member.renewer and admission is not None and _is_same_admission(member, admission.member):
            found = admission.member
        is_granted = not found.invitation
        if grant is not None and grant[0].not_before >= member.since:
            is_granted = True
            by = make_member(grant[0])
            origin = found.invitation, found.admitter
            found = replace(by, invitation=origin[0], admitter=origin[1], uses=found.uses)
        if held is not None:
            renewals.append(held.member)
        counting = [
            each
            for each in renewals
            if (not each.invitation and each.since == found.since if is_granted else _is_same_admission(each, found))
            and self._is_renewal_valid(each, now)
        ]
        last = max(counting, key=lambda each: each.not_after, default=found)
        if last.not_after <= found.not_after:
            return found
        return replace(found, not_after=last.not_after, renewer=last.renewer)

    def find_member(self, public: bytes, now: float) -> Member | None:
        """Return the last known state of ``public``, even if it is no longer a member."""
        admission, grant, renewal = self.find_admission(public), self.find_grant(public), self.find_renewal(public)
        if admission is not None:
            return self.update_member(admission.member, now)
        if grant is not None:
            return self.update_member(make_member(grant[0]), now)
        return None if renewal is None else self.update_member(renewal.member, now)

    def find_best_certificate(self, member: Member, certificate: bytes, now: float) -> bytes:
        """Return the certificate of ``member`` that ends last; ``certificate`` is its certificate as known so far."""
        known, renewal, grant = (
            self.update_member(member, now),
            self.find_renewal(member.public),
            self.find_grant(member.public),
        )
        if known.renewer:
            is_held = renewal is not None and renewal.member.not_after == known.not_after
            return renewal.certificate if renewal is not None and is_held else certificate
        if grant is not None and grant[0].not_before >= member.since:
            return wrap_grant(grant[1])
        admission = self.find_admission(member.public) if member.renewer else None
        return certificate if admission is None else admission.certificate

    def list_known_members(self, now: float) -> list[tuple[Member, str]]:
        """Return all current and former members by name, each with its refusal (empty for a current member)."""
        publics = [each.member.public for each in self._list_kind(SignedCertificate)]
        publics += [each.public for each in self._list_kind(Grant)]
        known = [each for public in dict.fromkeys(publics) if (each := self.find_member(public, now)) is not None]
        return [
            (each, self.find_refusal(each, now)) for each in sorted(known, key=lambda each: (each.name, each.public))
        ]

    def list_members(self, now: float) -> list[Member]:
        """Return the members at ``now``, by name."""
        return [each for each, refusal in self.list_known_members(now) if not refusal]

    def is_last_bootstrap(self, public: bytes, since: float, now: float) -> bool:
        """Return whether no other bootstrap node can renew certificates; the last one renews itself.

        A bootstrap node that the operator named after ``since`` does not count.  A bootstrap node whose certificate
        ends within two ``MIN_RENEWAL_S`` does not count either: it must be offline, because bootstrap nodes renew each
        other long before that.
        """
        publics = {each.public for each in self._list_kind(Grant)}
        publics |= {each.member.public for each in self._list_kind(Renewal)}
        for grant in map(self.find_grant, publics):
            if grant is None or grant[0].public == public or grant[0].not_before > since:
                continue
            other, renewal = grant[0], self.find_renewal(grant[0].public)
            end = other.not_after
            if renewal is not None and renewal.member.renewer != other.public:
                end = max(end, renewal.member.not_after)
            may_renew = (
                BOOTSTRAP in other.roles and other.life >= DEFAULT_LIFE_S and self.find_revocation(other.public) is None
            )
            if may_renew and now < end - 2 * MIN_RENEWAL_S:
                return False
        return True

    # -- implementation ---------------------------------------------------------------------------------------------

    def _parse(self, packed: bytes) -> Entry:
        fields = unpack_fields(packed)
        if len(fields) == 3 and fields[0] == ADMISSION_KIND:
            public, certificate = check_bytes(fields[1], 32), fields[2]
            if not isinstance(certificate, bytes):
                raise Malformed("the admission has no certificate")
            member = verify_certificate(self.operator, public, certificate)
            if member.renewer:
                return Renewal(member, certificate, extract_grant(self.operator, certificate))
            if not member.invitation:
                raise Malformed("the admission has no invitation")
            return Admission(member, certificate)
        return open_statement(self.operator, packed)

    def _check_room(self, entry: Entry, packed: bytes, now: float) -> None:
        """Raise ``Full`` if there is no room for ``entry``; a share of the room is reserved for the operator."""
        most, most_bytes = MAX_ENTRIES, MAX_BYTES
        if isinstance(entry, SignedCertificate):
            most, most_bytes = MAX_ENTRIES - RESERVED_ENTRIES, MAX_BYTES - RESERVED_BYTES
            member = entry.member
            users = self._users.get(member.invitation, Counter())
            if member.invitation and member.public not in users and len(users) >= member.uses:
                raise Full(f"the invitation by which {member.name} joined was already used {len(users)} times")
        for is_tried in (False, True):
            if len(self._entries) < most and self._bytes + len(packed) <= most_bytes:
                return
            if not is_tried:
                self._drop_ended(now)
        raise Full(f"the membership list is full: {len(self)} statements, {self._bytes} bytes")

    def _drop_ended(self, now: float) -> None:
        """Drop expired admissions and renewals that are kept only so that the operator can renew them.

        Grants stay: without an expired grant, an older statement about its key would apply again.
        """
        for key, held in list(self._entries.items()):
            if isinstance(held.entry, SignedCertificate) and held.entry.member.not_after <= now:
                self._remove(key)

    def _is_renewal_valid(self, renewal: Member, now: float) -> bool:
        """Return whether a renewal applies: its signer is a bootstrap node, or its signer's revocation keeps it.

        Dates of a revoked signer prove nothing, because it can sign any date.  A member can renew itself only if no
        other node can.
        """
        end, grant = self.find_revocation(renewal.renewer), self.find_grant(renewal.renewer)
        if end is not None and renewal_id(renewal.public, renewal.not_after) not in end.kept:
            return False
        if grant is not None and BOOTSTRAP not in grant[0].roles:
            return False
        if renewal.renewer == renewal.public and not self.is_last_bootstrap(renewal.public, renewal.not_before, now):
            return False
        return renewal.not_before <= now + MAX_CLOCK_SKEW_S

    def _is_invalid(self, entry: Entry, now: float) -> bool:
        """Return whether an admission or a renewal is permanently invalid."""
        if not isinstance(entry, SignedCertificate):
            return False
        member = entry.member
        if self.find_refusal(member, now) == "revoked":
            return True
        if not isinstance(entry, Renewal):
            return False
        grant, admission = self.find_grant(member.public), self.find_admission(member.public)
        if grant is not None and grant[0].not_before > member.since:
            return True  # the operator issued a later grant
        is_by_one_code = admission is not None and admission.member.invitation == member.invitation
        if admission is not None and is_by_one_code and not _is_same_admission(member, admission.member):
            return True
        return member.renewer != member.public and not self._is_renewal_valid(member, now)

    def _drop_invalid(self, keys: Iterable[bytes], now: float) -> None:
        """Drop entries that a revocation or a later grant invalidated."""
        void = [key for key in keys if self._is_invalid(self._entries[key].entry, now)]
        members = [each.member for key in void if isinstance(each := self._entries[key].entry, SignedCertificate)]
        for key in void:
            self._remove(key)
        self.invalidated = [each.public for each in members if self.find_refusal(each, now) == "revoked"]

    def _has_room_for_secret(self, secret: Secret) -> bool:
        known = self.list_secrets()
        if len(known) < MAX_SECRETS:
            return True
        oldest = known[-1]
        if secret.number <= oldest.number:
            return False
        self._remove(self._slots[oldest.slot])
        return True

    def _count_use(self, entry: Entry, step: int) -> None:
        """Count a key that joined by an invitation once, even if it has both an admission and a renewal."""
        if isinstance(entry, SignedCertificate) and entry.member.invitation:
            users = self._users.setdefault(entry.member.invitation, Counter())
            users[entry.member.public] += step
            users += Counter()  # drops keys with count 0
            if not users:
                del self._users[entry.member.invitation]

    def _find_packed(self, kind: type[Kind], public: bytes) -> tuple[Kind, bytes] | None:
        key = self._slots.get((kind.kind, public))
        held = None if key is None else self._entries[key]
        return (held.entry, held.packed) if held is not None and isinstance(held.entry, kind) else None

    def _find(self, kind: type[Kind], public: bytes) -> Kind | None:
        found = self._find_packed(kind, public)
        return None if found is None else found[0]

    def _list_kind(self, kind: type[Kind]) -> list[Kind]:
        return [held.entry for held in self._entries.values() if isinstance(held.entry, kind)]

    def _insert(self, key: bytes, held: StoredEntry) -> None:
        self._entries[key] = held
        self._slots[held.entry.slot] = key
        if isinstance(held.entry, Invite):
            self._by_id[invitation_id(held.entry.public)] = held.entry.public
        self._count_use(held.entry, 1)
        self._digest ^= int.from_bytes(key)
        self._bytes += len(held.packed)

    def _remove(self, key: bytes) -> None:
        held = self._entries.pop(key)
        self._slots.pop(held.entry.slot, None)
        if isinstance(held.entry, Invite):
            self._by_id.pop(invitation_id(held.entry.public), None)
        self._count_use(held.entry, -1)
        self._digest ^= int.from_bytes(key)
        self._bytes -= len(held.packed)


def _is_same_admission(member: Member, other: Member) -> bool:
    """Return whether both joined by the same code, bootstrap node and name."""
    return (member.invitation, member.admitter, member.name) == (other.invitation, other.admitter, other.name)
