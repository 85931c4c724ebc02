"""Posting: how a tuple, and the note that it was taken, stand in records; pure.

A publisher uses its slots again once their tuples are taken, so a tuple is known by its slot and a mark of its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgpack

from middleware.entangled.contact import Contact
from middleware.entangled.contact import unpacked as contact_unpacked
from middleware.entangled.errors import Malformed
from middleware.entangled.record import MAX_NAME, Record, Slot, hashed_key
from middleware.entangled.space.template import Tuple, tuple_unpacked

MAX_COUNCIL = 5
MARK_BYTES = 8
INCARNATION_BYTES = 8
MAX_NAME_BYTES = 40
_POSTED, _TAKEN = 1, 2


class Place(NamedTuple):
    """Which tuple: the slot it stands in, and its mark, which no other tuple of that slot has."""

    key: bytes
    owner: bytes
    name: str
    mark: bytes

    @property
    def slot(self) -> Slot:
        """Where its record lives."""
        return Slot(self.key, self.owner, self.name)

    def packed(self) -> list[object]:
        """The place as it stands in a message or record beside its key."""
        return [self.owner, self.name, self.mark]


@dataclass(frozen=True)
class Member:
    """A council member, and in which life it was asked to be one: a member that has lost its memory has no say."""

    contact: Contact
    incarnation: bytes


@dataclass(frozen=True)
class Posted:
    """A tuple as its publisher put it, with the council that decides who takes it."""

    place: Place
    fields: Tuple
    council: tuple[Member, ...]


@dataclass(frozen=True)
class Taken:
    """A note in a slot of whoever took the tuple of ``place``, or of whoever found out that it was taken."""

    place: Place
    taker: bytes


Standing = tuple[list[Posted], dict[Place, Taken]]


def space_key(space: str, arity: int) -> bytes:
    """The key under which the tuples of one space with ``arity`` fields are kept."""
    return hashed_key(f"tuples/{space}/{arity}")


def packed_tuple(mark: bytes, fields: Tuple, council: Sequence[Member]) -> bytes:
    """The value of the record of a tuple."""
    members = [[*member.contact.packed(), member.incarnation] for member in council]
    return bytes(msgpack.packb([_POSTED, mark, list(fields), members]))


def packed_taken(place: Place, taker: bytes) -> bytes:
    """The value of the record that notes that a tuple was taken."""
    return bytes(msgpack.packb([_TAKEN, place.packed(), taker]))


def posting(record: Record) -> Posted | Taken | None:
    """What a record of a space says, or None where it says nothing lawful."""
    try:
        fields = msgpack.unpackb(record.value or b"", strict_map_key=True, max_ext_len=0)
    except Exception:  # foreign code on foreign bytes
        return None
    match fields:
        case [1, bytes(mark), values, list(members)] if len(mark) == MARK_BYTES and 0 < len(members) <= MAX_COUNCIL:
            council = [member for member in map(_member, members) if member is not None]
            try:
                values = tuple_unpacked(values)
            except Malformed:
                return None
            if len({member.contact.public for member in council}) == len(members):
                return Posted(Place(*record.slot, mark), values, tuple(council))
        case [2, place, taker] if is_name(taker):
            about = place_unpacked(record.key, place)
            return None if about is None else Taken(about, taker)
    return None


def is_name(value: object) -> bool:
    """Whether ``value`` may be the name of a taker."""
    return type(value) is bytes and 0 < len(value) <= MAX_NAME_BYTES


def place_unpacked(key: bytes, fields: object) -> Place | None:
    """The place under ``key`` that ``Place.packed`` made, or None where the fields cannot be one."""
    match fields:
        case [bytes(owner), str(name), bytes(mark)] if (
            len(owner) == 32 and 0 < len(name) <= MAX_NAME and len(mark) == MARK_BYTES
        ):
            return Place(key, owner, name, mark)
    return None


class Reader:
    """Reads the postings of one key again and again; what has not changed is not decoded again."""

    def __init__(self) -> None:
        self._known: dict[tuple[bytes, bytes], Posted | Taken | None] = {}

    def standing(self, records: Iterable[Record]) -> Standing:
        """The tuples in ``records`` that nobody took, in their order, and what was taken."""
        before, self._known = self._known, {}
        posted: list[Posted] = []
        taken: dict[Place, Taken] = {}
        for record in records:
            mark = (record.owner, record.signature)
            said = self._known[mark] = before[mark] if mark in before else posting(record)
            if isinstance(said, Posted):
                posted.append(said)
            elif said is not None:
                taken[said.place] = said
        return [one for one in posted if one.place not in taken], taken


def standing(records: Iterable[Record]) -> Standing:
    """The tuples in ``records`` that nobody took, in their order, and what was taken."""
    return Reader().standing(records)


def _member(fields: object) -> Member | None:
    if not isinstance(fields, list) or len(fields) != 4:
        return None
    contact, incarnation = contact_unpacked(fields[:3]), fields[3]
    if contact is None or not isinstance(incarnation, bytes) or len(incarnation) != INCARNATION_BYTES:
        return None
    return Member(contact, incarnation)
