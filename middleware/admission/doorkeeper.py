"""Doorkeeper: the door of a closed team: who shows a pass of this team, and is not revoked, is let in.

What each role may do stands in ``roles``.
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
"""Guests of one gateway that a node lets in at a time."""
JUDGED_S = 1.0
"""Seconds for which the authority of an owner is remembered, unless the roll changes before."""
LIVED = "admission/life"
"""The note of the number of the node's last life."""


def begun(store: Store, wall: float, rng: random.Random) -> Life:
    """The life that begins now, noted in ``store``, where its number is higher than that of the last one."""
    try:
        last = int(store.noted(LIVED) or b"0")
    except ValueError:  # a rotten file may hold anything
        last = 0
    # In milliseconds: a guest may go and come again within a second, and keeps nothing meanwhile.
    number = next_life(max(0, last), wall * 1000.0)
    store.note(LIVED, b"%d" % number)
    return Life(number, rng.randbytes(NONCE))


class Doorkeeper:
    """Judges passes by the roll; a ``Door``.

    ``membership`` is what this node has of its own; passes that were found good are remembered by their digest, so that
    each costs its signatures once.
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
        self._shown: dict[bytes, bytes] = {}  # the passes of those of ``_met`` that are not on the roll
        self._authorities: dict[bytes, Authority] = {}
        self._judged_at = (b"", 0.0)

    @property
    def me(self) -> Member:
        """What this node is in its team."""
        return self._roll.known_as(self._me, self._wall())

    @property
    def shown(self) -> bytes:
        """The operator's last word about this node, or the pass that it got when it was let in, as it was renewed."""
        return self._roll.best_pass(self._me, self._membership().shown, self._wall())

    def judge(self, public: bytes, shown: bytes) -> str:
        """The name of the refusal of a node with this key that shows this pass; empty where it is let in."""
        try:
            member = self._read(public, shown)
        except RemoteError:
            return FOREIGN
        now = self._wall()
        return self._roll.refusal(self._roll.known_as(member, now), now) or self._count_guest(member)

    def admit(self, public: bytes, shown: bytes) -> str:
        """Judge a node that has confirmed its session, and remember it where it is let in."""
        refusal = self.judge(public, shown)
        if not refusal:
            member = self._read(public, shown)
            refusal = self._list(public, shown, member)
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
        """Whether ``public`` is the key of a present member that may call ``method``."""
        authority = self.authority(public)
        return not authority.refusal and roles.may_call(authority.roles, method)

    def roles_of(self, public: bytes) -> frozenset[str]:
        """Return the roles that the holder of that key has now, none for a stranger or a revoked or expired member."""
        return frozenset(self.authority(public).roles)

    def _list(self, public: bytes, shown: bytes, member: Member) -> str:
        """Have a member on the membership list, so that all know it and the operator can revoke it by name.

        Returns the refusal of one for whom the list has no room: who is not on it is no member.  A guest is not listed;
        its voucher is.  A renewal that the list does not have is listed, too.
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

    def _count_guest(self, member: Member) -> str:
        """Return a refusal where the voucher of a guest vouches for too many others at present."""
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
        """Whether the certificate of the owner of ``slot``, as it is at present, allows it to write there."""
        authority = self.authority(slot.owner)
        return not authority.refusal and roles.may_store(authority.roles, slot, authority.name)

    def may_stay(self, slot: Slot) -> bool:
        """Whether what is held in ``slot`` may be held on and shown."""
        return self.may_store(slot) or (self.authority(slot.owner).refusal != FOREIGN and roles.lasts(slot))

    def authority(self, owner: bytes) -> Authority:
        """Whether the certificate of an owner of records holds at present, its roles and its name."""
        now = self._wall()
        digest, at = self._judged_at
        if digest != self._roll.digest or not 0.0 <= now - at < JUDGED_S:
            self._authorities.clear()
            self._judged_at = (self._roll.digest, now)
        found = self._authorities.get(owner)
        if found is None:
            found = self._authorities[owner] = self._judged(owner, now)
            if len(self._authorities) > MAX_MET:
                del self._authorities[next(iter(self._authorities))]
        return found

    def certificate(self, owner: bytes) -> bytes:
        """The operator's last word about an owner, or the pass that it showed; empty where neither is known."""
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
        """Whether the roll says nothing of the holder of ``public``: a guest, or a member of which it has yet to."""
        known = self._roll.granted(public), self._roll.admitted(public), self._roll.renewal(public)
        return known == (None, None, None)

    def learn(self, owner: bytes, certificate: bytes) -> bool:
        """Take in the pass of an owner that another node showed; whether it holds."""
        return not self.admit(owner, certificate)

    def member(self, public: bytes) -> Member | None:
        """What is known of the holder of ``public``, met or only heard of."""
        if public == self._me.public:
            return self.me
        met, now = self._met.get(public), self._wall()
        return self._roll.member(public, now) if met is None else self._roll.known_as(met, now)

    def swept(self) -> list[tuple[bytes, str]]:
        """Those that were met and are members no more, each with the name of the refusal; each is told once."""
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

    def _judged(self, owner: bytes, now: float) -> Authority:
        if self._roll.revoked(owner) is not None:
            return Authority(REVOKED)
        member = self.member(owner)
        if member is None:
            return Authority(FOREIGN)
        refusal = self._roll.refusal(member, now)
        return Authority(refusal) if refusal else Authority("", member.roles, member.name)

    def _read(self, public: bytes, shown: bytes) -> Member:
        key = hashlib.blake2s(public + shown, digest_size=16).digest()
        member = self._passes.get(key)
        if member is None:
            member = self._passes[key] = member_of(self._roll.operator, public, shown)
            if len(self._passes) > MAX_PASSES:
                self._passes.popitem(last=False)
        else:
            self._passes.move_to_end(key)
        return member
