"""The records of a tuple space: tuples, and notes that a tuple was taken; pure.

A publisher reuses the slots of taken tuples, so a tuple is identified by its slot and a random mark.
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
    """The identity of a tuple: its slot and its mark, unique among the tuples of that slot."""

    key: bytes
    owner: bytes
    name: str
    mark: bytes

    @property
    def slot(self) -> Slot:
        """The slot of its record."""
        return Slot(self.key, self.owner, self.name)

    def packed(self) -> list[object]:
        """Return the fields for a message or record that contains the key separately."""
        return [self.owner, self.name, self.mark]


@dataclass(frozen=True)
class Member:
    """A council member and its incarnation at its enrolment; a member that lost its votes has another one."""

    contact: Contact
    incarnation: bytes


@dataclass(frozen=True)
class Posted:
    """A tuple with the council that decides about its taker."""

    place: Place
    fields: Tuple
    council: tuple[Member, ...]


@dataclass(frozen=True)
class Taken:
    """A note that ``taker`` took the tuple of ``place``, written by the taker or by a node that detected it."""

    place: Place
    taker: bytes


Standing = tuple[list[Posted], dict[Place, Taken]]


def space_key(space: str, arity: int) -> bytes:
    """Return the key of the tuples of one space with ``arity`` fields."""
    return hashed_key(f"tuples/{space}/{arity}")


def packed_tuple(mark: bytes, fields: Tuple, council: Sequence[Member]) -> bytes:
    """Return the value of a tuple's record."""
    members = [[*member.contact.packed(), member.incarnation] for member in council]
    return bytes(msgpack.packb([_POSTED, mark, list(fields), members]))


def packed_taken(place: Place, taker: bytes) -> bytes:
    """Return the value of a note that a tuple was taken."""
    return bytes(msgpack.packb([_TAKEN, place.packed(), taker]))


def posting(record: Record) -> Posted | Taken | None:
    """Parse a record of a space; None if it is invalid."""
    try:
        fields = msgpack.unpackb(record.value or b"", strict_map_key=True, max_ext_len=0)
    except Exception:  # msgpack on bytes from peers
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
    """Return whether ``value`` may be the name of a taker."""
    return type(value) is bytes and 0 < len(value) <= MAX_NAME_BYTES


def place_unpacked(key: bytes, fields: object) -> Place | None:
    """Parse the fields of ``Place.packed`` for ``key``; None if they are invalid."""
    match fields:
        case [bytes(owner), str(name), bytes(mark)] if (
            len(owner) == 32 and 0 < len(name) <= MAX_NAME and len(mark) == MARK_BYTES
        ):
            return Place(key, owner, name, mark)
    return None


class Reader:
    """Parses the records of one key repeatedly, with a cache for unchanged records."""

    def __init__(self) -> None:
        self._known: dict[tuple[bytes, bytes], Posted | Taken | None] = {}

    def standing(self, records: Iterable[Record]) -> Standing:
        """Return the tuples in ``records`` that were not taken, in order, and the notes of taken ones."""
        before, self._known = self._known, {}
        posted: list[Posted] = []
        taken: dict[Place, Taken] = {}
        for record in records:
            mark = (record.owner, record.signature)
            parsed = self._known[mark] = before[mark] if mark in before else posting(record)
            if isinstance(parsed, Posted):
                posted.append(parsed)
            elif parsed is not None:
                taken[parsed.place] = parsed
        return [one for one in posted if one.place not in taken], taken


def standing(records: Iterable[Record]) -> Standing:
    """Return the tuples in ``records`` that were not taken, in order, and the notes of taken ones."""
    return Reader().standing(records)


def _member(fields: object) -> Member | None:
    if not isinstance(fields, list) or len(fields) != 4:
        return None
    contact, incarnation = contact_unpacked(fields[:3]), fields[3]
    if contact is None or not isinstance(incarnation, bytes) or len(incarnation) != INCARNATION_BYTES:
        return None
    return Member(contact, incarnation)
