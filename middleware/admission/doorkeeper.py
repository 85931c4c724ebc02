"""Admission check of a closed team: verify passes against the membership list.

The module ``roles`` defines the permissions of each role.
"""

from __future__ import annotations

import hashlib
import random
from collections import OrderedDict
from collections.abc import Callable

from middleware.admission import roles
from middleware.admission.certificate import ROOM, Member, entries_of, member_by, member_of, pass_of
from middleware.admission.membership import Membership
from middleware.admission.roll import Roll
from middleware.entangled.data.store import Store
from middleware.entangled.errors import Full, RemoteError
from middleware.entangled.record import Slot
from middleware.entangled.wire.door import FOREIGN, NONCE, REVOKED, UNLISTED, Authority, Life, next_life

MAX_MET = 4096
MAX_PASSES = 1024
MAX_VOUCHED = 64
"""Maximum number of guests of one gateway that a node accepts at a time."""
JUDGED_S = 1.0
"""Seconds for which an owner's authority is cached, unless the membership list changes."""
LIVED = "admission/life"
"""Name of the stored note with the number of the node's last life."""


def begun(store: Store, wall: float, rng: random.Random) -> Life:
    """Start a new life with a higher number than the last one, and store the number in ``store``."""
    try:
        last = int(store.noted(LIVED) or b"0")
    except ValueError:  # damaged file
        last = 0
    # In milliseconds: a guest can leave and return within a second, and stores nothing in between.
    number = next_life(max(0, last), wall * 1000.0)
    store.note(LIVED, b"%d" % number)
    return Life(number, rng.randbytes(NONCE))


class Doorkeeper:
    """Verify passes against the membership list ``roll``; implements ``Door``.

    ``membership`` returns this node's own membership.  Verified passes are cached by digest, so each pass costs its
    signature checks once.
    """

    room = ROOM

    def __init__(self, roll: Roll, membership: Callable[[], Membership], wall: Callable[[], float], life: Life) -> None:
        self.life = life
        self.fingerprint = hashlib.blake2s(roll.operator, digest_size=8, person=b"team").digest()
        self._roll = roll
        self._membership = membership
        self._wall = wall
        self._me = membership().member
        self.list_entry: Callable[[bytes], object] = lambda packed: roll.add(packed, wall())
        self._passes: OrderedDict[bytes, Member] = OrderedDict()
        self._met: OrderedDict[bytes, Member] = OrderedDict()
        self._shown: dict[bytes, bytes] = {}  # passes of members in ``_met`` that are not on the list
        self._authorities: dict[bytes, Authority] = {}
        self._cached_at = (b"", 0.0)

    @property
    def me(self) -> Member:
        """This node as a member of its team."""
        return self._roll.known_as(self._me, self._wall())

    @property
    def shown(self) -> bytes:
        """The pass to show: the operator's latest grant, or the pass issued at admission, with its latest renewal."""
        return self._roll.best_pass(self._me, self._membership().shown, self._wall())

    def judge(self, public: bytes, shown: bytes) -> str:
        """Return the refusal for a node with key ``public`` and pass ``shown``; empty if it is accepted."""
        try:
            member = self._verify_pass(public, shown)
        except RemoteError:
            return FOREIGN
        now = self._wall()
        return self._roll.refusal(self._roll.known_as(member, now), now) or self._check_guest_quota(member)

    def admit(self, public: bytes, shown: bytes) -> str:
        """Judge a node that has confirmed its session, and remember it if it is accepted."""
        refusal = self.judge(public, shown)
        if not refusal:
            member = self._verify_pass(public, shown)
            refusal = self._add_to_list(public, shown, member)
        if not refusal:
            self._met[public] = member
            self._met.move_to_end(public)
            self._authorities.pop(public, None)
            if self.is_off_roll(public):
                self._shown[public] = shown
            if len(self._met) > MAX_MET:
                self._shown.pop(self._met.popitem(last=False)[0], None)
        return refusal

    def may(self, public: bytes, method: str) -> bool:
        """Return whether ``public`` is the key of a current member that may call ``method``."""
        authority = self.authority(public)
        return not authority.refusal and roles.may_call(authority.roles, method)

    def roles_of(self, public: bytes) -> frozenset[str]:
        """Return the current roles of a key; none for strangers and for revoked or expired members."""
        return frozenset(self.authority(public).roles)

    def _add_to_list(self, public: bytes, shown: bytes, member: Member) -> str:
        """Add a member to the membership list, so that all nodes know it and the operator can revoke it by name.

        Returns a refusal if the list is full, because only listed keys are members.  Guests are not listed; their
        gateway is.  Unknown renewals are listed, too.
        """
        entries = entries_of(public, shown) if member.voucher is None else []
        is_off_roll = self.is_off_roll(public)
        if public != self._me.public and (is_off_roll or member.renewer):
            try:
                for entry in entries:
                    if not self._roll.has(entry):
                        self.list_entry(entry)
            except (Full, RemoteError):
                return UNLISTED if is_off_roll else ""
        return ""

    def _check_guest_quota(self, member: Member) -> str:
        """Return a refusal if the guest's gateway already has the maximum number of other guests here."""
        if member.voucher is None:
            return ""
        now, voucher = self._wall(), member.voucher.public
        others = sum(
            each.voucher is not None
            and each.voucher.public == voucher
            and each.public != member.public
            and not each.trouble(now)
            for each in self._met.values()
        )
        return "" if others < MAX_VOUCHED else UNLISTED

    def may_store(self, slot: Slot) -> bool:
        """Return whether the current certificate of the owner of ``slot`` permits writing there."""
        authority = self.authority(slot.owner)
        return not authority.refusal and roles.may_store(authority.roles, slot, authority.name)

    def may_stay(self, slot: Slot) -> bool:
        """Return whether a stored record in ``slot`` may be kept and returned to readers."""
        return self.may_store(slot) or (self.authority(slot.owner).refusal != FOREIGN and roles.lasts(slot))

    def authority(self, owner: bytes) -> Authority:
        """Return whether the certificate of an owner of records is valid now, with its roles and name."""
        now = self._wall()
        digest, at = self._cached_at
        if digest != self._roll.digest or not 0.0 <= now - at < JUDGED_S:
            self._authorities.clear()
            self._cached_at = (self._roll.digest, now)
        found = self._authorities.get(owner)
        if found is None:
            found = self._authorities[owner] = self._compute_authority(owner, now)
            if len(self._authorities) > MAX_MET:
                del self._authorities[next(iter(self._authorities))]
        return found

    def certificate(self, owner: bytes) -> bytes:
        """Return an owner's pass: the operator's latest grant, or the pass it showed; empty if neither is known."""
        if owner == self._me.public:
            return self.shown
        now, grant, admission = self._wall(), self._roll.granted(owner), self._roll.admitted(owner)
        if admission is not None:
            return self._roll.best_pass(admission.member, admission.shown, now)
        if grant is not None:
            return self._roll.best_pass(member_by(grant[0]), pass_of(grant[1]), now)
        renewal = self._roll.renewal(owner)
        return self._shown.get(owner, b"") if renewal is None else renewal.shown

    def is_off_roll(self, public: bytes) -> bool:
        """Return whether the membership list has no entry for ``public``: a guest, or a member not listed yet."""
        known = self._roll.granted(public), self._roll.admitted(public), self._roll.renewal(public)
        return known == (None, None, None)

    def learn(self, owner: bytes, certificate: bytes) -> bool:
        """Accept an owner's pass that another node relayed; returns whether it is valid."""
        return not self.admit(owner, certificate)

    def member(self, public: bytes) -> Member | None:
        """Return the known member with key ``public``, from a session or from the membership list."""
        if public == self._me.public:
            return self.me
        met, now = self._met.get(public), self._wall()
        return self._roll.member(public, now) if met is None else self._roll.known_as(met, now)

    def swept(self) -> list[tuple[bytes, str]]:
        """Return and forget the nodes met that are no longer members, each with its refusal."""
        now = self._wall()
        gone = [
            (public, refusal)
            for public, member in self._met.items()
            if (refusal := self._roll.refusal(self._roll.known_as(member, now), now))
        ]
        for public, _ in gone:
            del self._met[public]
            self._shown.pop(public, None)
        return gone

    def _compute_authority(self, owner: bytes, now: float) -> Authority:
        if self._roll.revoked(owner) is not None:
            return Authority(REVOKED)
        member = self.member(owner)
        if member is None:
            return Authority(FOREIGN)
        refusal = self._roll.refusal(member, now)
        return Authority(refusal) if refusal else Authority("", member.roles, member.name)

    def _verify_pass(self, public: bytes, shown: bytes) -> Member:
        key = hashlib.blake2s(public + shown, digest_size=16).digest()
        member = self._passes.get(key)
        if member is None:
            member = self._passes[key] = member_of(self._roll.operator, public, shown)
            if len(self._passes) > MAX_PASSES:
                self._passes.popitem(last=False)
        else:
            self._passes.move_to_end(key)
        return member
