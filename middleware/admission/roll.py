"""Roll: the statements about a team that a node knows, and who has been admitted; what follows from them.

It only grows, but for what has run out: two nodes that know the same statements know the same, whatever the order in
which these came.  Of two statements about one thing the later one holds, and the other is let go of.  An admission (a
newcomer's key with the pass that a bootstrap node made) is kept beside them, so that names are not given twice, a
newcomer that asks another bootstrap node gets the same answer, and the operator sees who is a member.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import msgpack

from middleware.admission.certificate import ADMISSION, GATEWAY, Member, member_of
from middleware.admission.statement import (
    Grant,
    Invite,
    Revoke,
    Secret,
    Statement,
    Terms,
    member_id,
    opened,
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
DIGEST = 8
ID = 8


@dataclass(frozen=True)
class Admission:
    """A newcomer that was let in, and the pass that it shows."""

    member: Member
    shown: bytes

    @property
    def slot(self) -> tuple[str, bytes]:
        """What it is about."""
        return "admission", self.member.public

    @property
    def rank(self) -> int:
        """Which of two holds: the one of the higher rank."""
        return self.member.not_before

    @property
    def until(self) -> int:
        """Until when it is worth being remembered."""
        return self.member.not_after


Entry = Statement | Admission


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
    """An admission as it travels; it needs no signature of its own."""
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
        self._uses: Counter[bytes] = Counter()
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
        if entry.until <= now:
            return None
        if isinstance(entry, Admission) and self.refusal(entry.member, now) == "revoked":
            return None
        before = self._slots.get(entry.slot)
        if before is not None and (entry.rank, packed) <= (self._held[before].entry.rank, self._held[before].packed):
            return None
        if before is not None:
            self._let_go(before)
        if isinstance(entry, Secret) and not self._has_room_for_secret(entry):
            return None
        self._check_room(entry, packed)
        self._hold(key, Held(entry, packed))
        if isinstance(entry, Revoke):
            self._drop_void(now)
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
        entry = self._at("revoke", public)
        return entry if isinstance(entry, Revoke) else None

    def granted(self, public: bytes) -> tuple[Grant, bytes] | None:
        """What the operator granted to the holder of ``public``, and that as packed."""
        key = self._slots.get(("grant", public))
        held = None if key is None else self._held[key]
        return (held.entry, held.packed) if held is not None and isinstance(held.entry, Grant) else None

    def invited(self, name: bytes) -> tuple[Invite, bytes] | None:
        """The invitation with that id, and it as packed."""
        key = self._slots.get(("invite", self._by_id.get(name, b"")))
        held = None if key is None else self._held[key]
        return (held.entry, held.packed) if held is not None and isinstance(held.entry, Invite) else None

    def terms_of(self, invitation: bytes) -> bytes | None:
        """Return the sealed terms of the invitation with that public key; None where they are not known."""
        entry = self._at("terms", invitation)
        return entry.sealed if isinstance(entry, Terms) else None

    def admitted(self, public: bytes) -> Admission | None:
        """How the holder of ``public`` was let in."""
        entry = self._at("admission", public)
        return entry if isinstance(entry, Admission) else None

    def secrets(self) -> list[Secret]:
        """The statements that carry the team's secrets, the newest first."""
        found = [entry for entry in self._entries() if isinstance(entry, Secret)]
        return sorted(found, key=lambda each: -each.number)

    def invites(self) -> list[Invite]:
        """All invitations that are remembered, the oldest first."""
        return sorted((each for each in self._entries() if isinstance(each, Invite)), key=lambda each: each.not_before)

    def revocations(self) -> list[Revoke]:
        """All revocations."""
        return [each for each in self._entries() if isinstance(each, Revoke)]

    def admissions(self) -> list[Admission]:
        """All that were let in by a bootstrap node."""
        return [each for each in self._entries() if isinstance(each, Admission)]

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
            voucher = self.known_as(member.voucher)
            if GATEWAY not in voucher.roles:
                return "role"
            return self.refusal(voucher, now) or member.trouble(now)
        return member.trouble(now)

    def known_as(self, member: Member) -> Member:
        """``member`` as the operator's latest word about its key has it, where there is a later one than its pass."""
        grant = self.granted(member.public)
        if grant is None or grant[0].not_before < member.not_before:
            return member
        latest, _ = grant
        begin, end = latest.not_before, latest.not_after
        return replace(member, name=latest.name, roles=latest.roles, not_before=begin, not_after=end)

    def members(self, now: float) -> list[Member]:
        """All that are members at that moment, by name."""
        found = {each.member.public: each.member for each in self._entries() if isinstance(each, Admission)}
        for each in self._entries():
            if isinstance(each, Grant):
                plain = Member(each.public, each.name, each.roles, each.not_before, each.not_after)
                found[each.public] = self.known_as(found.get(each.public, plain))
        return sorted(
            (each for each in found.values() if not self.refusal(each, now)), key=lambda each: (each.name, each.public)
        )

    # -- inside -----------------------------------------------------------------------------------------------------

    def _read(self, packed: bytes) -> Entry:
        fields = unpacked(packed)
        if len(fields) == 3 and fields[0] == ADMISSION:
            public, shown = sized(fields[1], 32), fields[2]
            if not isinstance(shown, bytes):
                raise Malformed("an admission without a pass")
            member = member_of(self.operator, public, shown)
            if not member.invitation:
                raise Malformed("an admission without an invitation")
            return Admission(member, shown)
        return opened(self.operator, packed)

    def _check_room(self, entry: Entry, packed: bytes) -> None:
        """Raise ``Full`` where there is no room for ``entry``; a part of the room is for the operator alone."""
        most, most_bytes = MAX_ENTRIES, MAX_BYTES
        if isinstance(entry, Admission):
            most, most_bytes = MAX_ENTRIES - RESERVED, MAX_BYTES - RESERVED_BYTES
            used = self._uses[entry.member.invitation]
            if used >= entry.member.uses:
                raise Full(f"the invitation by which {entry.member.name} came was used {used} times already")
        if len(self._held) >= most or self._bytes + len(packed) > most_bytes:
            raise Full(
                f"the roll of the team holds {len(self)} statements, {self._bytes} bytes; it has no room for more"
            )

    def _drop_void(self, now: float) -> None:
        """Let go of the admissions that a revocation made void; whoever shows one is refused by the revocation."""
        void = [
            key
            for key, held in self._held.items()
            if isinstance(held.entry, Admission) and self.refusal(held.entry.member, now) == "revoked"
        ]
        self.void = [held.entry.member.public for key in void if isinstance((held := self._held[key]).entry, Admission)]
        for key in void:
            self._let_go(key)

    def _has_room_for_secret(self, secret: Secret) -> bool:
        known = self.secrets()
        if len(known) < MAX_SECRETS:
            return True
        oldest = known[-1]
        if secret.number <= oldest.number:
            return False
        self._let_go(self._slots[oldest.slot])
        return True

    def _at(self, kind: str, public: bytes) -> Entry | None:
        key = self._slots.get((kind, public))
        return None if key is None else self._held[key].entry

    def _entries(self) -> Iterator[Entry]:
        return (held.entry for held in self._held.values())

    def _hold(self, key: bytes, held: Held) -> None:
        self._held[key] = held
        self._slots[held.entry.slot] = key
        if isinstance(held.entry, Invite):
            self._by_id[invitation_id(held.entry.public)] = held.entry.public
        if isinstance(held.entry, Admission):
            self._uses[held.entry.member.invitation] += 1
        self._digest ^= int.from_bytes(key)
        self._bytes += len(held.packed)

    def _let_go(self, key: bytes) -> None:
        held = self._held.pop(key)
        self._slots.pop(held.entry.slot, None)
        if isinstance(held.entry, Invite):
            self._by_id.pop(invitation_id(held.entry.public), None)
        if isinstance(held.entry, Admission):
            self._uses[held.entry.member.invitation] -= 1
            self._uses += Counter()  # drops the invitations that have no admission left
        self._digest ^= int.from_bytes(key)
        self._bytes -= len(held.packed)
