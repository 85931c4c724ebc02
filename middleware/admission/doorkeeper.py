"""Doorkeeper: the door of a closed team: who shows a pass of this team, and is not revoked, is let in.

What each role may do is not decided here: the rules are handed in.
"""

from __future__ import annotations

import hashlib
import random
from collections import OrderedDict
from collections.abc import Callable, Collection
from typing import Protocol

from middleware.admission.certificate import ROOM, Member, member_of, pass_of
from middleware.admission.membership import Membership
from middleware.admission.roll import Roll
from middleware.entangled.data.store import Store
from middleware.entangled.errors import RemoteError
from middleware.entangled.record import Slot
from middleware.entangled.wire.door import FOREIGN, NONCE, Life, next_life

MAX_MET = 4096
MAX_PASSES = 1024
LIVED = "admission/life"
"""The note of the number of the node's last life."""


class Rules(Protocol):
    """What each role may do."""

    def may_call(self, roles: Collection[str], method: str) -> bool:
        """Whether a member with these roles may call that method."""

    def may_store(self, roles: Collection[str], slot: Slot, name: str) -> bool:
        """Whether a member with these roles and that name may write that slot of its own."""


class Anything:
    """Rules by which every member may do everything."""

    def may_call(self, roles: Collection[str], method: str) -> bool:
        """It may."""
        return True

    def may_store(self, roles: Collection[str], slot: Slot, name: str) -> bool:
        """It may."""
        return True


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

    def __init__(
        self, roll: Roll, membership: Callable[[], Membership], wall: Callable[[], float], life: Life, rules: Rules
    ) -> None:
        self.life = life
        self.fingerprint = hashlib.blake2s(roll.operator, digest_size=8, person=b"team").digest()
        self._roll = roll
        self._membership = membership
        self._wall = wall
        self._rules = rules
        self._me = membership().member
        self._passes: OrderedDict[bytes, Member] = OrderedDict()
        self._met: OrderedDict[bytes, Member] = OrderedDict()

    @property
    def me(self) -> Member:
        """What this node is in its team."""
        return self._roll.known_as(self._me)

    @property
    def shown(self) -> bytes:
        """The operator's last word about this node, or the pass that it got when it was let in."""
        grant = self._roll.granted(self._me.public)
        if grant is not None and grant[0].not_before >= self._me.not_before:
            return pass_of(grant[1])
        return self._membership().shown

    def judge(self, public: bytes, shown: bytes) -> str:
        """The name of the refusal of a node with this key that shows this pass; empty where it is let in."""
        try:
            member = self._roll.known_as(self._read(public, shown))
        except RemoteError:
            return FOREIGN
        refusal = self._roll.refusal(member, self._wall())
        if not refusal:
            self._met[public] = member
            self._met.move_to_end(public)
            if len(self._met) > MAX_MET:
                self._met.popitem(last=False)
        return refusal

    def may(self, public: bytes, method: str) -> bool:
        """Whether a node that was let in may call ``method``."""
        member = self.member(public)
        return member is not None and self._rules.may_call(member.roles, method)

    def may_store(self, slot: Slot) -> bool:
        """Whether the owner of ``slot`` may write there; of an owner whom nobody here knows it says yes."""
        member = self.member(slot.owner)
        return member is None or self._rules.may_store(member.roles, slot, member.name)

    def name_of(self, public: bytes) -> str:
        """The name in the certificate of the holder of ``public``; empty where nobody here knows it."""
        member = self.member(public)
        return "" if member is None else member.name

    def member(self, public: bytes) -> Member | None:
        """What is known of the holder of ``public``, met or only heard of."""
        if public == self._me.public:
            return self.me
        met = self._met.get(public)
        if met is not None:
            return self._roll.known_as(met)
        admission = self._roll.admitted(public)
        if admission is not None:
            return self._roll.known_as(admission.member)
        grant = self._roll.granted(public)
        if grant is None:
            return None
        found, _ = grant
        return Member(public, found.name, found.roles, found.not_before, found.not_after)

    def swept(self) -> list[tuple[bytes, str]]:
        """Those that were met and are members no more, each with the name of the refusal; each is told once."""
        now = self._wall()
        gone = [
            (public, refusal)
            for public, member in self._met.items()
            if (refusal := self._roll.refusal(self._roll.known_as(member), now))
        ]
        for public, _ in gone:
            del self._met[public]
        return gone

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
