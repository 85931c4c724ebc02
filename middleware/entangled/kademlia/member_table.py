"""Store all members of a small team, and determine the voters for majorities.

Records are stored at the closest *live* members.  Majorities are counted among the closest of all members, including
absent members, because a failed member is indistinguishable from a partitioned one.  Therefore two majorities share a
member even if they are formed on different sides of a partition.

An absent member is removed from the voters in two cases.  It is removed after ``ABSENT_WITH_MAJORITY_S`` if the other
members that are in contact are a majority of all members (dynamic voting; Jajodia and Mutchler, 1990); thus members may
leave one after the other.  In any case it is removed after ``MAX_ABSENT_S``, which limits the tolerated duration of a
partition.

A newcomer is *settled* when it has synchronised with a majority of the earlier members.  Until then it is not counted
in majorities; otherwise newcomers could turn the smaller side of a partition into a majority.
"""

from __future__ import annotations

from collections.abc import Iterable

from middleware.entangled.contact import Contact

MAX_MEMBERS = 64
"""The size of a team up to which each node knows all members; in a larger team Kademlia lookups are cheaper than
complete knowledge.
"""
ABSENT_WITH_MAJORITY_S = 30.0
"""The seconds of three rounds of repair; after them, other replicas store the records of the absent member."""
MAX_ABSENT_S = 120.0
"""The longest partition in seconds in which majorities remain valid.  A higher value is safer; a lower value allows
writes earlier."""


class _Member:
    """A member; ``lost_at`` is None while it is considered alive."""

    __slots__ = ("contact", "number", "last_received_at", "lost_at", "is_voter")

    def __init__(self, contact: Contact, now: float, lost_at: float | None = None) -> None:
        self.contact = contact
        self.number = int.from_bytes(contact.node_id)
        self.last_received_at = now
        self.lost_at = lost_at
        self.is_voter = True


class MemberTable:
    """The members that the node ``own_id`` knows, except itself; times are seconds of one clock.

    ``version`` changes whenever a member appears or disappears; ``is_settled`` is the state of this node itself.
    """

    def __init__(self, own_id: bytes) -> None:
        self._own_number = int.from_bytes(own_id)
        self._members: dict[bytes, _Member] = {}
        self._live: list[_Member] = []
        self._absent: list[_Member] = []
        self.version = 0
        self.is_voter = True
        self._digest = _compute_digest(self._own_number, ())

    def __len__(self) -> int:
        return len(self._live)

    @property
    def is_full(self) -> bool:
        """Whether the table is full, so the team may be larger than the table."""
        return len(self._members) >= MAX_MEMBERS

    def get(self, node_id: bytes) -> Contact | None:
        """Return the live member with this id."""
        member = self._members.get(node_id)
        return member.contact if member is not None and member.lost_at is None else None

    def mark_alive(self, contact: Contact, now: float) -> bool:
        """Record that ``contact`` is alive; return whether it is new or was absent.

        Nothing is added to a full table.
        """
        member = self._members.get(contact.node_id)
        if member is None:
            if self.is_full and not self._make_room():
                return False
            self._members[contact.node_id] = _Member(contact, now)
        elif member.lost_at is None:
            member.contact, member.last_received_at = contact, now
            return False
        else:
            member.contact, member.last_received_at, member.lost_at = contact, now, None
        self._sort()
        return True

    def add_absent(self, contact: Contact, now: float) -> None:
        """Add ``contact``, known from storage or other nodes, as absent since ``now`` until it answers."""
        if contact.node_id not in self._members and not self.is_full:
            self._members[contact.node_id] = _Member(contact, now, lost_at=now)
            self._sort()

    def mark_absent(self, node_id: bytes, now: float) -> bool:
        """Record that a member does not answer; return whether it was present until now."""
        member = self._members.get(node_id)
        if member is None or member.lost_at is not None:
            return False
        member.lost_at = now
        self._sort()
        return True

    def remove(self, node_id: bytes) -> None:
        """Delete a member that left, which is then no longer a voter."""
        if self._members.pop(node_id, None) is not None:
            self._sort()

    def remove_all(self, node_ids: Iterable[bytes]) -> None:
        """Delete members when the network is large, because majorities are then not counted in this table."""
        found = [self._members.pop(node_id) for node_id in node_ids if node_id in self._members]
        if found:
            self._sort()

    def set_voter(self, node_id: bytes, is_settled: bool = True) -> None:
        """Record whether a member has synchronised and is therefore counted as a voter."""
        member = self._members.get(node_id)
        if member is not None:
            member.is_voter = is_settled

    def list_live(self) -> list[Contact]:
        """Return the live members, in the order of their ids."""
        return [member.contact for member in self._live]

    def list_absent(self) -> list[Contact]:
        """Return the absent members that are still voters, in the order of their ids."""
        return [member.contact for member in self._absent]

    def list_voters(self, now: float) -> list[tuple[Contact, float]]:
        """Return the settled members, each with the seconds of its absence."""
        present = [(m.contact, 0.0) for m in self._live if m.is_voter]
        return present + [(m.contact, now - m.lost_at) for m in self._absent if m.lost_at is not None and m.is_voter]

    def closest(self, key: bytes, count: int, me: Contact) -> list[Contact]:
        """Return the ``count`` live members closest to ``key``, including this node (``me``), closest first."""
        goal = int.from_bytes(key)
        near = [(member.number ^ goal, member.contact) for member in self._live]
        near.append((self._own_number ^ goal, me))
        near.sort(key=lambda pair: pair[0])
        return [contact for _, contact in near[:count]]

    def digest(self) -> bytes:
        """Return eight bytes that are equal if two nodes know the same live members, including themselves."""
        return self._digest

    def is_majority_alive(self, now: float, within: float) -> bool:
        """Return whether this node and the members heard within ``within`` seconds are a majority of the settled."""
        return self._is_majority([member for member in self._live if now - member.last_received_at <= within])

    def remove_expired(self, now: float) -> list[Contact]:
        """Delete the absent members that are no longer voters, and return them."""
        wait = ABSENT_WITH_MAJORITY_S if self._is_majority(self._live) else MAX_ABSENT_S
        struck = [m for m in self._absent if m.lost_at is not None and now - m.lost_at > wait]
        for member in struck:
            del self._members[member.contact.node_id]
        if struck:
            self._sort()
        return [member.contact for member in struck]

    def _is_majority(self, present: list[_Member]) -> bool:
        """Return whether ``present`` and this node are a majority of the settled members; True if none is settled."""
        total = self.is_voter + sum(member.is_voter for member in self._members.values())
        return not total or 2 * (self.is_voter + sum(member.is_voter for member in present)) > total

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
        self._digest = _compute_digest(self._own_number, self._live)


def _compute_digest(own_number: int, live: Iterable[_Member]) -> bytes:
    mixed = own_number
    for member in live:
        mixed ^= member.number
    return (mixed & (2**64 - 1)).to_bytes(8)
