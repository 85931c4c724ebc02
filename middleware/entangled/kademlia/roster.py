"""Roster: all members of a team that is small enough to be known whole, and who of them counts in a majority.

Pure.  Records are stored at the closest *live* members; majorities are counted among the closest of all members, those
that are only absent included, for nobody can tell a dead member from one behind a partition.  Two majorities then
share a member, whatever side they were formed on.  An absent member stops to count in two cases: where a majority of
all members is in touch and has gone on without it for ``STRUCK_S`` (dynamic voting; Jajodia and Mutchler, 1990), so
that one after the other may leave; or after ``COUNTED_S``, whoever is in touch: longer than that no partition is
waited for.

A newcomer is *settled* when it has once caught up with a majority of those before it; until then it counts in no
majority of members, or the few behind a cut could strike the many with the help of strangers.
"""

from __future__ import annotations

from collections.abc import Iterable

from middleware.entangled.contact import Contact

MAX_MEMBERS = 64
"""Members that are known whole.  Beyond it a walk by Kademlia costs less than keeping everybody in mind."""
STRUCK_S = 30.0
"""Three rounds of mending: by then heirs hold what the absent member held."""
COUNTED_S = 120.0
"""The longest partition over which majorities stay majorities; more is safer, less writes again sooner."""


class _Member:
    """A member; ``lost_at`` is None while it lives, as far as is known."""

    __slots__ = ("contact", "number", "heard_at", "lost_at", "is_settled")

    def __init__(self, contact: Contact, now: float, lost_at: float | None = None) -> None:
        self.contact = contact
        self.number = int.from_bytes(contact.node_id)
        self.heard_at = now
        self.lost_at = lost_at
        self.is_settled = True


class Roster:
    """The members that the node ``own_id`` knows, itself not among them; moments are seconds of one clock.

    ``version`` is another one whenever somebody came or went; ``is_settled`` says whether this node itself is settled.
    """

    def __init__(self, own_id: bytes) -> None:
        self._own_number = int.from_bytes(own_id)
        self._members: dict[bytes, _Member] = {}
        self._live: list[_Member] = []
        self._absent: list[_Member] = []
        self.version = 0
        self.is_settled = True
        self._digest = _digest_of(self._own_number, ())

    def __len__(self) -> int:
        return len(self._live)

    @property
    def is_full(self) -> bool:
        """Whether there is no room for another member, so that the team may be larger than what is known."""
        return len(self._members) >= MAX_MEMBERS

    def get(self, node_id: bytes) -> Contact | None:
        """The live member with this id."""
        member = self._members.get(node_id)
        return member.contact if member is not None and member.lost_at is None else None

    def heard(self, contact: Contact, now: float) -> bool:
        """Take note that ``contact`` lives; whether it is new or was absent.  With a full roster, nobody new enters."""
        member = self._members.get(contact.node_id)
        if member is None:
            if self.is_full and not self._make_room():
                return False
            self._members[contact.node_id] = _Member(contact, now)
        elif member.lost_at is None:
            member.contact, member.heard_at = contact, now
            return False
        else:
            member.contact, member.heard_at, member.lost_at = contact, now, None
        self._sort()
        return True

    def remembered(self, contact: Contact, now: float) -> None:
        """Count ``contact``, known in an earlier life or to others, as absent since ``now`` until it is heard."""
        if contact.node_id not in self._members and not self.is_full:
            self._members[contact.node_id] = _Member(contact, now, lost_at=now)
            self._sort()

    def lost(self, node_id: bytes, now: float) -> bool:
        """Take note that a member answers no more; whether it was there until now."""
        member = self._members.get(node_id)
        if member is None or member.lost_at is not None:
            return False
        member.lost_at = now
        self._sort()
        return True

    def left(self, node_id: bytes) -> None:
        """Strike a member that said goodbye: it counts no more."""
        if self._members.pop(node_id, None) is not None:
            self._sort()

    def shed(self, node_ids: Iterable[bytes]) -> None:
        """Strike some, where the network is too large for majorities to be counted here."""
        found = [self._members.pop(node_id) for node_id in node_ids if node_id in self._members]
        if found:
            self._sort()

    def settle(self, node_id: bytes, is_settled: bool = True) -> None:
        """Take note whether a member has once caught up, so that it counts; who says nothing else does."""
        member = self._members.get(node_id)
        if member is not None:
            member.is_settled = is_settled

    def live(self) -> list[Contact]:
        """The members that live, in the order of their ids."""
        return [member.contact for member in self._live]

    def absent(self) -> list[Contact]:
        """The members that are absent and still count, in the order of their ids."""
        return [member.contact for member in self._absent]

    def known(self, now: float) -> list[tuple[Contact, float]]:
        """The settled members, and for how many seconds they have been absent."""
        there = [(m.contact, 0.0) for m in self._live if m.is_settled]
        return there + [(m.contact, now - m.lost_at) for m in self._absent if m.lost_at is not None and m.is_settled]

    def closest(self, key: bytes, count: int, me: Contact) -> list[Contact]:
        """The ``count`` live members closest to ``key``, this node (``me``) among them, closest first."""
        goal = int.from_bytes(key)
        near = [(member.number ^ goal, member.contact) for member in self._live]
        near.append((self._own_number ^ goal, me))
        near.sort(key=lambda pair: pair[0])
        return [contact for _, contact in near[:count]]

    def digest(self) -> bytes:
        """Eight bytes that tell whether two nodes know the same live members, themselves included."""
        return self._digest

    def in_touch(self, now: float, within: float) -> bool:
        """Whether a majority of all settled members was heard in the last ``within`` seconds, this node counted in."""
        return self._is_majority([member for member in self._live if now - member.heard_at <= within])

    def strike(self, now: float) -> list[Contact]:
        """Strike absent members as the module says, and return them."""
        wait = STRUCK_S if self._is_majority(self._live) else COUNTED_S
        struck = [m for m in self._absent if m.lost_at is not None and now - m.lost_at > wait]
        for member in struck:
            del self._members[member.contact.node_id]
        if struck:
            self._sort()
        return [member.contact for member in struck]

    def _is_majority(self, there: list[_Member]) -> bool:
        """Whether these and this node are a majority of the settled members; before there are any, everybody is."""
        everybody = self.is_settled + sum(member.is_settled for member in self._members.values())
        return not everybody or 2 * (self.is_settled + sum(member.is_settled for member in there)) > everybody

    def _make_room(self) -> bool:
        if not self._absent:
            return False
        oldest = min(self._absent, key=lambda member: member.lost_at or 0.0)
        del self._members[oldest.contact.node_id]
        return True

    def _sort(self) -> None:
        self.version += 1
        members = sorted(self._members.values(), key=lambda member: member.number)
        self._live = [member for member in members if member.lost_at is None]
        self._absent = [member for member in members if member.lost_at is not None]
        self._digest = _digest_of(self._own_number, self._live)


def _digest_of(own_number: int, live: Iterable[_Member]) -> bytes:
    mixed = own_number
    for member in live:
        mixed ^= member.number
    return (mixed & (2**64 - 1)).to_bytes(8)
