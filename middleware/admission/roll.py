"""Roll: the statements about a team that a node knows, and who has been admitted; what follows from them.

It only grows, but for what has run out: two nodes that know the same statements know the same, whatever the order in
which these came.  Of two statements about one thing the later one holds, and the other is let go of.  An admission (a
newcomer's key with the pass that a bootstrap node made) is kept beside them, so that names are not given twice, a
newcomer that asks another bootstrap node gets the same answer, and the operator sees who is a member.  So is the newest
renewal of each key: it moves the end of what the operator or an admission said of the key, and changes nothing else.
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
"""Of these, what admissions, which bootstrap nodes sign, leave to the statements of the operator."""
MAX_SECRETS = 4
"""Secrets of the team that are remembered, the newest."""
STEP = 7 * 86_400
"""Seconds that a renewal adds at least, and by which the ends of bootstrap nodes may differ before one is renewed."""
DIGEST = 8
ID = 8


@dataclass(frozen=True)
class SignedPass(Entry):
    """The pass that a member shows, signed by a bootstrap node."""

    member: Member
    shown: bytes

    @property
    def slot(self) -> tuple[str, bytes]:
        """The kind of the entry and the member's key."""
        return self.kind, self.member.public

    @property
    def until(self) -> int:
        """As long as the operator may want to renew it."""
        return remembered_until(self.member.not_after, self.member.life)


@dataclass(frozen=True)
class Admission(SignedPass):
    """A newcomer that was let in."""

    kind = "admission"

    @property
    def rank(self) -> int:
        """The later one holds."""
        return self.member.not_before


@dataclass(frozen=True)
class Renewal(SignedPass):
    """A member whose certificate a bootstrap node renewed.

    ``grant`` is what the operator granted it, and that as packed; None where it came by a code.
    """

    kind = "renewal"
    grant: tuple[Grant, bytes] | None

    @property
    def rank(self) -> int:
        """The one that ends later holds, so no bootstrap node can shorten what another one gave."""
        return self.member.not_after


Kind = TypeVar("Kind", bound=Entry)


class Held(NamedTuple):
    """An entry, as it is packed."""

    entry: Entry
    packed: bytes


def digest_of(packed: bytes) -> bytes:
    """By what an entry is told from others."""
    return hashlib.blake2s(packed, digest_size=DIGEST).digest()


def invitation_id(public: bytes) -> bytes:
    """By what a newcomer names its invitation in clear."""
    return hashlib.blake2s(public, digest_size=ID, person=b"invite").digest()


def packed_admission(public: bytes, shown: bytes) -> bytes:
    """An admission or a renewal as it travels; it needs no signature of its own."""
    return bytes(msgpack.packb([ADMISSION, public, shown]))


class Roll:
    """What a node knows of the team of the operator with the public key ``operator``; plain logic, no clock.

    ``now`` is in seconds of the wall clock.
    """

    def __init__(self, operator: bytes) -> None:
        self.operator = operator
        self._held: dict[bytes, Held] = {}
        self._slots: dict[tuple[str, bytes], bytes] = {}
        self._by_id: dict[bytes, bytes] = {}
        self.void: list[bytes] = []
        """The keys of those whose admissions the last revocation made void."""
        self._uses: dict[bytes, Counter[bytes]] = {}  # of each invitation the keys that came by it
        self._digest = 0
        self._bytes = 0

    def __len__(self) -> int:
        """How many entries there are."""
        return len(self._held)

    @property
    def digest(self) -> bytes:
        """Eight bytes that two nodes have in common when they know the same."""
        return self._digest.to_bytes(DIGEST)

    @property
    def digests(self) -> list[bytes]:
        """That of each entry."""
        return list(self._held)

    def packed(self, wanted: Iterable[bytes] | None = None) -> list[bytes]:
        """The entries with those digests, or all, as they travel."""
        keys = self._held if wanted is None else wanted
        return [self._held[key].packed for key in keys if key in self._held]

    def has(self, packed: bytes) -> bool:
        """Whether this entry is held."""
        return digest_of(packed) in self._held

    def add(self, packed: object, now: float) -> Entry | None:
        """Take an entry in; returns it where it is new and holds, else None.

        Raises ``Malformed`` or ``Forged`` for what is none of this team, and ``Full`` where there is no room.
        """
        if not isinstance(packed, bytes):
            raise Malformed("an entry of the roll is a string of bytes")
        key = digest_of(packed)
        if key in self._held:
            return None
        entry = self._read(packed)
        if entry.until <= now or self._is_void(entry, now):
            return None
        before = self._slots.get(entry.slot)
        if before is not None and (entry.rank, packed) <= (self._held[before].entry.rank, self._held[before].packed):
            return None
        if before is not None:
            self._let_go(before)
        if isinstance(entry, Secret) and not self._has_room_for_secret(entry):
            return None
        self._check_room(entry, packed, now)
        self._hold(key, Held(entry, packed))
        if isinstance(entry, Revoke) or (isinstance(entry, Grant) and before is not None):
            self._drop_void(self._held, now)
        elif isinstance(entry, Grant):
            self._drop_void([self._slots[slot] for slot in [(Renewal.kind, entry.public)] if slot in self._slots], now)
        return entry

    def expire(self, now: float) -> int:
        """Let go of what has run out; returns how much that was."""
        gone = [key for key, held in self._held.items() if held.entry.until <= now]
        for key in gone:
            self._let_go(key)
        return len(gone)

    # -- questions --------------------------------------------------------------------------------------------------

    def revoked(self, public: bytes) -> Revoke | None:
        """The revocation of a member's key, or of an invitation's."""
        return self._at(Revoke, public)

    def granted(self, public: bytes) -> tuple[Grant, bytes] | None:
        """What the operator granted to the holder of ``public``, and that as packed."""
        found, renewal = self._held_at(Grant, public), self.renewal(public)
        other = None if renewal is None else renewal.grant
        if found is None or (other is not None and found[0].not_before < other[0].not_before):
            return other
        return found

    def invited(self, name: bytes) -> tuple[Invite, bytes] | None:
        """The invitation with that id, and it as packed."""
        return self._held_at(Invite, self._by_id.get(name, b""))

    def terms_of(self, invitation: bytes) -> bytes | None:
        """Return the sealed terms of the invitation with that public key; None where they are not known."""
        entry = self._at(Terms, invitation)
        return None if entry is None else entry.sealed

    def admitted(self, public: bytes) -> Admission | None:
        """How the holder of ``public`` was let in."""
        return self._at(Admission, public)

    def renewal(self, public: bytes) -> Renewal | None:
        """The newest renewal of the certificate of ``public``."""
        return self._at(Renewal, public)

    def secrets(self) -> list[Secret]:
        """The statements that carry the team's secrets, the newest first."""
        return sorted(self._all(Secret), key=lambda each: -each.number)

    def invites(self) -> list[Invite]:
        """All invitations that are remembered, the oldest first."""
        return sorted(self._all(Invite), key=lambda each: each.not_before)

    def revocations(self) -> list[Revoke]:
        """All revocations."""
        return self._all(Revoke)

    def admissions(self) -> list[Admission]:
        """All that were let in by a bootstrap node."""
        return self._all(Admission)

    def refusal(self, member: Member, now: float) -> str:
        """Why a member is none any more: ``revoked``, ``expired`` or ``early``; empty where it is one."""
        if self.revoked(member.public) is not None or (
            member.invitation and self.revoked(member.invitation) is not None
        ):
            return "revoked"
        if member.admitter:
            # Dates say nothing: who has the key of a revoked bootstrap node can sign any.
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
        """``member``, as its pass says it, by the operator's latest word about its key and the renewal that ends last.

        A renewal counts for the word that it renews, and no later one; and only if its signer may renew at present.
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
            and self._counts(each, now)
        ]
        last = max(counting, key=lambda each: each.not_after, default=found)
        if last.not_after <= found.not_after:
            return found
        return replace(found, not_after=last.not_after, renewer=last.renewer)

    def member(self, public: bytes, now: float) -> Member | None:
        """What is known of the holder of ``public``, whether it is a member at present or not."""
        admission, grant, renewal = self.admitted(public), self.granted(public), self.renewal(public)
        if admission is not None:
            return self.known_as(admission.member, now)
        if grant is not None:
            return self.known_as(member_by(grant[0]), now)
        return None if renewal is None else self.known_as(renewal.member, now)

    def best_pass(self, member: Member, shown: bytes, now: float) -> bytes:
        """The pass to show for ``member``, which the pass ``shown`` says: that of the latest end."""
        known, renewal, grant = self.known_as(member, now), self.renewal(member.public), self.granted(member.public)
        if known.renewer:
            is_held = renewal is not None and renewal.member.not_after == known.not_after
            return renewal.shown if renewal is not None and is_held else shown
        if grant is not None and grant[0].not_before >= member.since:
            return pass_of(grant[1])
        admission = self.admitted(member.public) if member.renewer else None
        return shown if admission is None else admission.shown

    def remembered(self, now: float) -> list[tuple[Member, str]]:
        """All that are or were members, by name, each with why it is none at present (empty: it is one)."""
        publics = [each.member.public for each in self._all(SignedPass)]
        publics += [each.public for each in self._all(Grant)]
        known = [each for public in dict.fromkeys(publics) if (each := self.member(public, now)) is not None]
        return [(each, self.refusal(each, now)) for each in sorted(known, key=lambda each: (each.name, each.public))]

    def members(self, now: float) -> list[Member]:
        """All that are members at that moment, by name."""
        return [each for each, refusal in self.remembered(now) if not refusal]

    def is_last_bootstrap(self, public: bytes, since: float, now: float) -> bool:
        """Whether no bootstrap node but ``public`` can renew others: such a one renews itself.

        One that the operator named after ``since`` does not count, nor one that ends within two ``STEP``: bootstrap
        nodes renew each other long before that, so it is gone.
        """
        publics = {each.public for each in self._all(Grant)}
        publics |= {each.member.public for each in self._all(Renewal)}
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

    # -- inside -----------------------------------------------------------------------------------------------------

    def _read(self, packed: bytes) -> Entry:
        fields = unpacked(packed)
        if len(fields) == 3 and fields[0] == ADMISSION:
            public, shown = sized(fields[1], 32), fields[2]
            if not isinstance(shown, bytes):
                raise Malformed("an admission without a pass")
            member = member_of(self.operator, public, shown)
            if member.renewer:
                return Renewal(member, shown, grant_of(self.operator, shown))
            if not member.invitation:
                raise Malformed("an admission without an invitation")
            return Admission(member, shown)
        return opened(self.operator, packed)

    def _check_room(self, entry: Entry, packed: bytes, now: float) -> None:
        """Raise ``Full`` where there is no room for ``entry``; a part of the room is for the operator alone."""
        most, most_bytes = MAX_ENTRIES, MAX_BYTES
        if isinstance(entry, SignedPass):
            most, most_bytes = MAX_ENTRIES - RESERVED, MAX_BYTES - RESERVED_BYTES
            member = entry.member
            users = self._uses.get(member.invitation, Counter())
            if member.invitation and member.public not in users and len(users) >= member.uses:
                raise Full(f"the invitation by which {member.name} came was used {len(users)} times already")
        for is_tried in (False, True):
            if len(self._held) < most and self._bytes + len(packed) <= most_bytes:
                return
            if not is_tried:
                self._drop_ended(now)
        raise Full(f"the roll of the team holds {len(self)} statements, {self._bytes} bytes; it has no room for more")

    def _drop_ended(self, now: float) -> None:
        """Let go of admissions and renewals that have ended and are remembered so that the operator can renew them.

        Grants stay: with one that ended its key would fall back to what was said of it before.
        """
        for key, held in list(self._held.items()):
            if isinstance(held.entry, SignedPass) and held.entry.member.not_after <= now:
                self._let_go(key)

    def _counts(self, renewal: Member, now: float) -> bool:
        """Whether a renewal counts: its signer is a bootstrap node, or was when the operator revoked it and kept this.

        Dates say nothing of a revoked signer: it can sign any.  A member renews itself only where no other one can.
        """
        end, grant = self.revoked(renewal.renewer), self.granted(renewal.renewer)
        if end is not None and renewal_id(renewal.public, renewal.not_after) not in end.kept:
            return False
        if grant is not None and BOOTSTRAP not in grant[0].roles:
            return False
        if renewal.renewer == renewal.public and not self.is_last_bootstrap(renewal.public, renewal.not_before, now):
            return False
        return renewal.not_before <= now + SKEW

    def _is_void(self, entry: Entry, now: float) -> bool:
        """Whether an admission or a renewal does not count, whatever moment it is."""
        if not isinstance(entry, SignedPass):
            return False
        member = entry.member
        if self.refusal(member, now) == "revoked":
            return True
        if not isinstance(entry, Renewal):
            return False
        grant, admission = self.granted(member.public), self.admitted(member.public)
        if grant is not None and grant[0].not_before > member.since:
            return True  # the operator said something else since
        is_by_one_code = admission is not None and admission.member.invitation == member.invitation
        if admission is not None and is_by_one_code and not _is_same_admission(member, admission.member):
            return True
        return member.renewer != member.public and not self._counts(member, now)

    def _drop_void(self, keys: Iterable[bytes], now: float) -> None:
        """Let go of what a revocation or a later grant made void; whoever shows it is refused by that statement."""
        void = [key for key in keys if self._is_void(self._held[key].entry, now)]
        members = [each.member for key in void if isinstance(each := self._held[key].entry, SignedPass)]
        for key in void:
            self._let_go(key)
        self.void = [each.public for each in members if self.refusal(each, now) == "revoked"]

    def _has_room_for_secret(self, secret: Secret) -> bool:
        known = self.secrets()
        if len(known) < MAX_SECRETS:
            return True
        oldest = known[-1]
        if secret.number <= oldest.number:
            return False
        self._let_go(self._slots[oldest.slot])
        return True

    def _count_use(self, entry: Entry, step: int) -> None:
        """Count a key that came by an invitation: once, whether it is known by its admission, a renewal, or both."""
        if isinstance(entry, SignedPass) and entry.member.invitation:
            users = self._uses.setdefault(entry.member.invitation, Counter())
            users[entry.member.public] += step
            users += Counter()  # drops those of which nothing is left
            if not users:
                del self._uses[entry.member.invitation]

    def _held_at(self, kind: type[Kind], public: bytes) -> tuple[Kind, bytes] | None:
        key = self._slots.get((kind.kind, public))
        held = None if key is None else self._held[key]
        return (held.entry, held.packed) if held is not None and isinstance(held.entry, kind) else None

    def _at(self, kind: type[Kind], public: bytes) -> Kind | None:
        found = self._held_at(kind, public)
        return None if found is None else found[0]

    def _all(self, kind: type[Kind]) -> list[Kind]:
        return [held.entry for held in self._held.values() if isinstance(held.entry, kind)]

    def _hold(self, key: bytes, held: Held) -> None:
        self._held[key] = held
        self._slots[held.entry.slot] = key
        if isinstance(held.entry, Invite):
            self._by_id[invitation_id(held.entry.public)] = held.entry.public
        self._count_use(held.entry, 1)
        self._digest ^= int.from_bytes(key)
        self._bytes += len(held.packed)

    def _let_go(self, key: bytes) -> None:
        held = self._held.pop(key)
        self._slots.pop(held.entry.slot, None)
        if isinstance(held.entry, Invite):
            self._by_id.pop(invitation_id(held.entry.public), None)
        self._count_use(held.entry, -1)
        self._digest ^= int.from_bytes(key)
        self._bytes -= len(held.packed)


def _is_same_admission(member: Member, other: Member) -> bool:
    """Whether both came by one code, at one bootstrap node and under one name."""
    return (member.invitation, member.admitter, member.name) == (other.invitation, other.admitter, other.name)
