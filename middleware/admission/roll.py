"""Membership list of a closed team: the operator's statements and the admissions that a node knows.

Entries are only added, until they expire, so the list is a grow-only set: two nodes with the same statements have the
same state, in whatever order the statements arrived.  Of two statements about the same subject the later one wins, and
the other is dropped.  The list also contains admissions (a newcomer's key with the pass that a bootstrap node issued),
so that names stay unique, a newcomer gets the same reply from every bootstrap node, and the operator sees the members;
and the newest renewal of each key, which changes only the end date of its grant or admission.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import msgpack

from middleware.admission.certificate import (
    ADMISSION,
    BOOTSTRAP,
    GATEWAY,
    SKEW,
    Member,
    grant_of,
    member_by,
    member_of,
    pass_of,
)
from middleware.admission.statement import (
    YEAR,
    Entry,
    Grant,
    Invite,
    Revoke,
    Secret,
    Terms,
    member_id,
    opened,
    remembered_until,
    renewal_id,
    sized,
    unpacked,
)
from middleware.entangled.errors import Full, Malformed

MAX_ENTRIES = 4096
MAX_BYTES = 2**20
RESERVED, RESERVED_BYTES = 1024, 2**18
"""The share of the limits that is reserved for statements of the operator; bootstrap nodes sign admissions."""
MAX_SECRETS = 4
"""Number of team secrets that are kept, newest first."""
STEP = 7 * 86_400
"""Minimum seconds that a renewal adds; also the maximum gap between end dates of bootstrap nodes before a renewal."""
DIGEST = 8
ID = 8


@dataclass(frozen=True)
class SignedPass(Entry):
    """The pass of a member, signed by a bootstrap node."""

    member: Member
    shown: bytes

    @property
    def slot(self) -> tuple[str, bytes]:
        """The kind of the entry and the member's key."""
        return self.kind, self.member.public

    @property
    def until(self) -> int:
        """The time from which the operator can no longer renew it."""
        return remembered_until(self.member.not_after, self.member.life)


@dataclass(frozen=True)
class Admission(SignedPass):
    """A newcomer that a bootstrap node admitted."""

    kind = "admission"

    @property
    def rank(self) -> int:
        """The later admission wins."""
        return self.member.not_before


@dataclass(frozen=True)
class Renewal(SignedPass):
    """A member whose certificate a bootstrap node renewed.

    ``grant`` is the operator's grant, parsed and packed; None if the member joined by a code.
    """

    kind = "renewal"
    grant: tuple[Grant, bytes] | None

    @property
    def rank(self) -> int:
        """The renewal that ends later wins, so no bootstrap node can shorten another one's renewal."""
        return self.member.not_after


Kind = TypeVar("Kind", bound=Entry)


class Held(NamedTuple):
    """An entry, parsed and packed."""

    entry: Entry
    packed: bytes


def digest_of(packed: bytes) -> bytes:
    """Return the digest that identifies an entry."""
    return hashlib.blake2s(packed, digest_size=DIGEST).digest()


def invitation_id(public: bytes) -> bytes:
    """Return the id by which a join request names its invitation in clear text."""
    return hashlib.blake2s(public, digest_size=ID, person=b"invite").digest()


def packed_admission(public: bytes, shown: bytes) -> bytes:
    """Pack an admission or a renewal; the pass in it is signed."""
    return bytes(msgpack.packb([ADMISSION, public, shown]))


class Roll:
    """The membership list of the team with the operator key ``operator``; pure logic without a clock.

    ``now`` is in seconds of the wall clock.
    """

    def __init__(self, operator: bytes) -> None:
        self.operator = operator
        self._held: dict[bytes, Held] = {}
        self._slots: dict[tuple[str, bytes], bytes] = {}
        self._by_id: dict[bytes, bytes] = {}
        self.void: list[bytes] = []
        """Keys of the members whose admission the last revocation invalidated."""
        self._uses: dict[bytes, Counter[bytes]] = {}  # keys of the members that joined by each invitation
        self._digest = 0
        self._bytes = 0

    def __len__(self) -> int:
        """Return the number of entries."""
        return len(self._held)

    @property
    def digest(self) -> bytes:
        """Eight bytes that are equal at two nodes with the same entries."""
        return self._digest.to_bytes(DIGEST)

    @property
    def digests(self) -> list[bytes]:
        """The digest of each entry."""
        return list(self._held)

    def packed(self, wanted: Iterable[bytes] | None = None) -> list[bytes]:
        """Return the packed entries with those digests, or all."""
        keys = self._held if wanted is None else wanted
        return [self._held[key].packed for key in keys if key in self._held]

    def has(self, packed: bytes) -> bool:
        """Return whether the list contains this entry."""
        return digest_of(packed) in self._held

    def add(self, packed: object, now: float) -> Entry | None:
        """Add an entry; returns it if it is new and valid, else None.

        Raises ``Malformed`` or ``Forged`` for an entry that is not of this team, and ``Full`` if there is no room.
        """
        if not isinstance(packed, bytes):
            raise Malformed("an entry of the membership list has to be bytes")
        key = digest_of(packed)
        if key in self._held:
            return None
        entry = self._parse(packed)
        if entry.until <= now or self._is_invalid(entry, now):
            return None
        before = self._slots.get(entry.slot)
        if before is not None and (entry.rank, packed) <= (self._held[before].entry.rank, self._held[before].packed):
            return None
        if before is not None:
            self._remove(before)
        if isinstance(entry, Secret) and not self._has_room_for_secret(entry):
            return None
        self._check_room(entry, packed, now)
        self._insert(key, Held(entry, packed))
        if isinstance(entry, Revoke) or (isinstance(entry, Grant) and before is not None):
            self._drop_invalid(self._held, now)
        elif isinstance(entry, Grant):
            self._drop_invalid(
                [self._slots[slot] for slot in [(Renewal.kind, entry.public)] if slot in self._slots], now
            )
        return entry

    def expire(self, now: float) -> int:
        """Drop expired entries, and return their number."""
        gone = [key for key, held in self._held.items() if held.entry.until <= now]
        for key in gone:
            self._remove(key)
        return len(gone)

    # -- queries ----------------------------------------------------------------------------------------------------

    def revoked(self, public: bytes) -> Revoke | None:
        """Return the revocation of a member's or an invitation's key."""
        return self._find(Revoke, public)

    def granted(self, public: bytes) -> tuple[Grant, bytes] | None:
        """Return the operator's grant for ``public``, parsed and packed."""
        found, renewal = self._find_packed(Grant, public), self.renewal(public)
        other = None if renewal is None else renewal.grant
        if found is None or (other is not None and found[0].not_before < other[0].not_before):
            return other
        return found

    def invited(self, name: bytes) -> tuple[Invite, bytes] | None:
        """Return the invitation with that id, parsed and packed."""
        return self._find_packed(Invite, self._by_id.get(name, b""))

    def terms_of(self, invitation: bytes) -> bytes | None:
        """Return the encrypted terms of the invitation with that public key; None if they are not known."""
        entry = self._find(Terms, invitation)
        return None if entry is None else entry.sealed

    def admitted(self, public: bytes) -> Admission | None:
        """Return the admission of ``public``."""
        return self._find(Admission, public)

    def renewal(self, public: bytes) -> Renewal | None:
        """Return the newest renewal of the certificate of ``public``."""
        return self._find(Renewal, public)

    def secrets(self) -> list[Secret]:
        """Return the statements with the team's secrets, newest first."""
        return sorted(self._list_kind(Secret), key=lambda each: -each.number)

    def invites(self) -> list[Invite]:
        """Return all known invitations, oldest first."""
        return sorted(self._list_kind(Invite), key=lambda each: each.not_before)

    def revocations(self) -> list[Revoke]:
        """Return all revocations."""
        return self._list_kind(Revoke)

    def admissions(self) -> list[Admission]:
        """Return all admissions by bootstrap nodes."""
        return self._list_kind(Admission)

    def refusal(self, member: Member, now: float) -> str:
        """Return ``revoked``, ``expired``, ``early`` or ``role`` for a key that is not a member; empty for a member."""
        if self.revoked(member.public) is not None or (
            member.invitation and self.revoked(member.invitation) is not None
        ):
            return "revoked"
        if member.admitter:
            # Dates prove nothing: the holder of a revoked bootstrap node's key can sign any date.
            end = self.revoked(member.admitter)
            if end is not None and member_id(member.public) not in end.kept:
                return "revoked"
        if member.voucher is not None:
            voucher = self.known_as(member.voucher, now)
            if GATEWAY not in voucher.roles:
                return "role"
            return self.refusal(voucher, now) or member.trouble(now)
        return member.trouble(now)

    def known_as(self, member: Member, now: float) -> Member:
        """Update ``member`` from its pass with the operator's latest grant and the renewal that ends last.

        A renewal applies only to the grant that it renews, and only if its signer may renew now.
        """
        found, renewals = member.unrenewed, [member] if member.renewer else []
        grant, held = self.granted(member.public), self.renewal(member.public)
        admission = self.admitted(member.public)
        if member.renewer and admission is not None and _is_same_admission(member, admission.member):
            found = admission.member
        is_granted = not found.invitation
        if grant is not None and grant[0].not_before >= member.since:
            is_granted = True
            by = member_by(grant[0])
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

    def member(self, public: bytes, now: float) -> Member | None:
        """Return the last known state of ``public``, also if it is not a member now."""
        admission, grant, renewal = self.admitted(public), self.granted(public), self.renewal(public)
        if admission is not None:
            return self.known_as(admission.member, now)
        if grant is not None:
            return self.known_as(member_by(grant[0]), now)
        return None if renewal is None else self.known_as(renewal.member, now)

    def best_pass(self, member: Member, shown: bytes, now: float) -> bytes:
        """Return the pass with the latest end to show for ``member``, whose pass is ``shown``."""
        known, renewal, grant = self.known_as(member, now), self.renewal(member.public), self.granted(member.public)
        if known.renewer:
            is_held = renewal is not None and renewal.member.not_after == known.not_after
            return renewal.shown if renewal is not None and is_held else shown
        if grant is not None and grant[0].not_before >= member.since:
            return pass_of(grant[1])
        admission = self.admitted(member.public) if member.renewer else None
        return shown if admission is None else admission.shown

    def remembered(self, now: float) -> list[tuple[Member, str]]:
        """Return all current and former members by name, each with its refusal (empty for a current member)."""
        publics = [each.member.public for each in self._list_kind(SignedPass)]
        publics += [each.public for each in self._list_kind(Grant)]
        known = [each for public in dict.fromkeys(publics) if (each := self.member(public, now)) is not None]
        return [(each, self.refusal(each, now)) for each in sorted(known, key=lambda each: (each.name, each.public))]

    def members(self, now: float) -> list[Member]:
        """Return the members at ``now``, by name."""
        return [each for each, refusal in self.remembered(now) if not refusal]

    def is_last_bootstrap(self, public: bytes, since: float, now: float) -> bool:
        """Return whether no other bootstrap node can renew certificates; the last one renews itself.

        A bootstrap node that the operator named after ``since`` does not count, nor does one that ends within two
        ``STEP``: bootstrap nodes renew each other long before that, so it is offline.
        """
        publics = {each.public for each in self._list_kind(Grant)}
        publics |= {each.member.public for each in self._list_kind(Renewal)}
        for grant in map(self.granted, publics):
            if grant is None or grant[0].public == public or grant[0].not_before > since:
                continue
            other, renewal = grant[0], self.renewal(grant[0].public)
            end = other.not_after
            if renewal is not None and renewal.member.renewer != other.public:
                end = max(end, renewal.member.not_after)
            may_renew = BOOTSTRAP in other.roles and other.life >= YEAR and self.revoked(other.public) is None
            if may_renew and now < end - 2 * STEP:
                return False
        return True

    # -- implementation ---------------------------------------------------------------------------------------------

    def _parse(self, packed: bytes) -> Entry:
        fields = unpacked(packed)
        if len(fields) == 3 and fields[0] == ADMISSION:
            public, shown = sized(fields[1], 32), fields[2]
            if not isinstance(shown, bytes):
                raise Malformed("the admission has no pass")
            member = member_of(self.operator, public, shown)
            if member.renewer:
                return Renewal(member, shown, grant_of(self.operator, shown))
            if not member.invitation:
                raise Malformed("the admission has no invitation")
            return Admission(member, shown)
        return opened(self.operator, packed)

    def _check_room(self, entry: Entry, packed: bytes, now: float) -> None:
        """Raise ``Full`` if there is no room for ``entry``; a share of the room is reserved for the operator."""
        most, most_bytes = MAX_ENTRIES, MAX_BYTES
        if isinstance(entry, SignedPass):
            most, most_bytes = MAX_ENTRIES - RESERVED, MAX_BYTES - RESERVED_BYTES
            member = entry.member
            users = self._uses.get(member.invitation, Counter())
            if member.invitation and member.public not in users and len(users) >= member.uses:
                raise Full(f"the invitation by which {member.name} joined was already used {len(users)} times")
        for is_tried in (False, True):
            if len(self._held) < most and self._bytes + len(packed) <= most_bytes:
                return
            if not is_tried:
                self._drop_ended(now)
        raise Full(f"the membership list is full: {len(self)} statements, {self._bytes} bytes")

    def _drop_ended(self, now: float) -> None:
        """Drop expired admissions and renewals that are kept only so that the operator can renew them.

        Grants stay: without an expired grant, an older statement about its key would apply again.
        """
        for key, held in list(self._held.items()):
            if isinstance(held.entry, SignedPass) and held.entry.member.not_after <= now:
                self._remove(key)

    def _is_renewal_valid(self, renewal: Member, now: float) -> bool:
        """Return whether a renewal applies: its signer is a bootstrap node, or was revoked and the renewal kept.

        Dates of a revoked signer prove nothing, because it can sign any date.  A member can renew itself only if no
        other node can.
        """
        end, grant = self.revoked(renewal.renewer), self.granted(renewal.renewer)
        if end is not None and renewal_id(renewal.public, renewal.not_after) not in end.kept:
            return False
        if grant is not None and BOOTSTRAP not in grant[0].roles:
            return False
        if renewal.renewer == renewal.public and not self.is_last_bootstrap(renewal.public, renewal.not_before, now):
            return False
        return renewal.not_before <= now + SKEW

    def _is_invalid(self, entry: Entry, now: float) -> bool:
        """Return whether an admission or a renewal is invalid at any time."""
        if not isinstance(entry, SignedPass):
            return False
        member = entry.member
        if self.refusal(member, now) == "revoked":
            return True
        if not isinstance(entry, Renewal):
            return False
        grant, admission = self.granted(member.public), self.admitted(member.public)
        if grant is not None and grant[0].not_before > member.since:
            return True  # the operator issued a later grant
        is_by_one_code = admission is not None and admission.member.invitation == member.invitation
        if admission is not None and is_by_one_code and not _is_same_admission(member, admission.member):
            return True
        return member.renewer != member.public and not self._is_renewal_valid(member, now)

    def _drop_invalid(self, keys: Iterable[bytes], now: float) -> None:
        """Drop entries that a revocation or a later grant invalidated; that statement also rejects them when shown."""
        void = [key for key in keys if self._is_invalid(self._held[key].entry, now)]
        members = [each.member for key in void if isinstance(each := self._held[key].entry, SignedPass)]
        for key in void:
            self._remove(key)
        self.void = [each.public for each in members if self.refusal(each, now) == "revoked"]

    def _has_room_for_secret(self, secret: Secret) -> bool:
        known = self.secrets()
        if len(known) < MAX_SECRETS:
            return True
        oldest = known[-1]
        if secret.number <= oldest.number:
            return False
        self._remove(self._slots[oldest.slot])
        return True

    def _count_use(self, entry: Entry, step: int) -> None:
        """Count a key that joined by an invitation once, even if it has both an admission and a renewal."""
        if isinstance(entry, SignedPass) and entry.member.invitation:
            users = self._uses.setdefault(entry.member.invitation, Counter())
            users[entry.member.public] += step
            users += Counter()  # drops keys with count 0
            if not users:
                del self._uses[entry.member.invitation]

    def _find_packed(self, kind: type[Kind], public: bytes) -> tuple[Kind, bytes] | None:
        key = self._slots.get((kind.kind, public))
        held = None if key is None else self._held[key]
        return (held.entry, held.packed) if held is not None and isinstance(held.entry, kind) else None

    def _find(self, kind: type[Kind], public: bytes) -> Kind | None:
        found = self._find_packed(kind, public)
        return None if found is None else found[0]

    def _list_kind(self, kind: type[Kind]) -> list[Kind]:
        return [held.entry for held in self._held.values() if isinstance(held.entry, kind)]

    def _insert(self, key: bytes, held: Held) -> None:
        self._held[key] = held
        self._slots[held.entry.slot] = key
        if isinstance(held.entry, Invite):
            self._by_id[invitation_id(held.entry.public)] = held.entry.public
        self._count_use(held.entry, 1)
        self._digest ^= int.from_bytes(key)
        self._bytes += len(held.packed)

    def _remove(self, key: bytes) -> None:
        held = self._held.pop(key)
        self._slots.pop(held.entry.slot, None)
        if isinstance(held.entry, Invite):
            self._by_id.pop(invitation_id(held.entry.public), None)
        self._count_use(held.entry, -1)
        self._digest ^= int.from_bytes(key)
        self._bytes -= len(held.packed)


def _is_same_admission(member: Member, other: Member) -> bool:
    """Return whether both joined by the same code, bootstrap node and name."""
    return (member.invitation, member.admitter, member.name) == (other.invitation, other.admitter, other.name)
