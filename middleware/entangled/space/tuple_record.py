"""The records of a tuple space: tuples, and notes that a tuple was taken; without I/O.

A publisher reuses the slots of taken tuples, so a tuple is identified by its slot and a random mark.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgpack

from middleware.entangled.contact import Contact
from middleware.entangled.contact import parse_contact as contact_unpacked
from middleware.entangled.errors import Malformed
from middleware.entangled.record import MAX_NAME_BYTES, Record, Slot, hash_key
from middleware.entangled.space.template import Tuple, parse_tuple

MAX_COUNCIL_MEMBERS = 5
MARK_BYTES = 8
INCARNATION_BYTES = 8
MAX_TAKER_NAME_BYTES = 40
_TUPLE, _TAKEN = 1, 2


class TupleId(NamedTuple):
    """The identity of a tuple: its slot and its mark, unique among the tuples of that slot."""

    key: bytes
    owner: bytes
    name: str
    mark: bytes

    @property
    def slot(self) -> Slot:
        """The slot of the tuple's record."""
        return Slot(self.key, self.owner, self.name)

    def pack(self) -> list[object]:
        """Return the fields for a message or record that contains the key separately."""
        return [self.owner, self.name, self.mark]


@dataclass(frozen=True)
class Member:
    """A council member and its incarnation at its enrolment; the incarnation changes if it loses its votes."""

    contact: Contact
    incarnation: bytes


@dataclass(frozen=True)
class StoredTuple:
    """A tuple with the council that decides about its taker."""

    tuple_id: TupleId
    fields: Tuple
    council: tuple[Member, ...]


@dataclass(frozen=True)
class TakenNote:
    """A note that ``taker`` took a tuple, written by the taker or by a node that detected the take."""

    tuple_id: TupleId
    taker: bytes


SpaceContents = tuple[list[StoredTuple], dict[TupleId, TakenNote]]


def space_key(space: str, arity: int) -> bytes:
    """Return the key of the tuples of one space with ``arity`` fields."""
    return hash_key(f"tuples/{space}/{arity}")


def pack_tuple(mark: bytes, fields: Tuple, council: Sequence[Member]) -> bytes:
    """Return the value of a tuple's record."""
    members = [[*member.contact.pack(), member.incarnation] for member in council]
    return bytes(msgpack.packb([_TUPLE, mark, list(fields), members]))


def pack_taken(tuple_id: TupleId, taker: bytes) -> bytes:
    """Return the value of a note that a tuple was taken."""
    return bytes(msgpack.packb([_TAKEN, tuple_id.pack(), taker]))


def parse_record(record: Record) -> StoredTuple | TakenNote | None:
    """Parse a record of a space; None if it is invalid."""
    try:
        fields = msgpack.unpackb(record.value or b"", strict_map_key=True, max_ext_len=0)
    except Exception:  # msgpack raises many types on invalid bytes of peers
        return None
    match fields:
        case [1, bytes(mark), values, list(members)] if (
            len(mark) == MARK_BYTES and 0 < len(members) <= MAX_COUNCIL_MEMBERS
        ):
            council = [member for member in map(_parse_member, members) if member is not None]
            try:
                values = parse_tuple(values)
            except Malformed:
                return None
            if len({member.contact.public for member in council}) == len(members):
                return StoredTuple(TupleId(*record.slot, mark), values, tuple(council))
        case [2, place, taker] if is_taker_name(taker):
            about = parse_tuple_id(record.key, place)
            return None if about is None else TakenNote(about, taker)
    return None


def is_taker_name(value: object) -> bool:
    """Return whether ``value`` may be the name of a taker."""
    return type(value) is bytes and 0 < len(value) <= MAX_TAKER_NAME_BYTES


def parse_tuple_id(key: bytes, fields: object) -> TupleId | None:
    """Parse the fields of ``TupleId.pack`` for ``key``; None if they are invalid."""
    match fields:
        case [bytes(owner), str(name), bytes(mark)] if (
            len(owner) == 32 and 0 < len(name) <= MAX_NAME_BYTES and len(mark) == MARK_BYTES
        ):
            return TupleId(key, owner, name, mark)
    return None


class RecordParser:
    """Parses the records of one key repeatedly, with a cache for unchanged records."""

    def __init__(self) -> None:
        self._parsed: dict[tuple[bytes, bytes], StoredTuple | TakenNote | None] = {}

    def parse(self, records: Iterable[Record]) -> SpaceContents:
        """Return the tuples in ``records`` that were not taken, in order, and the notes of taken tuples."""
        before, self._parsed = self._parsed, {}
        stored: list[StoredTuple] = []
        taken: dict[TupleId, TakenNote] = {}
        for record in records:
            mark = (record.owner, record.signature)
            parsed = self._parsed[mark] = before[mark] if mark in before else parse_record(record)
            if isinstance(parsed, StoredTuple):
                stored.append(parsed)
            elif parsed is not None:
                taken[parsed.tuple_id] = parsed
        return [one for one in stored if one.tuple_id not in taken], taken


def parse_records(records: Iterable[Record]) -> SpaceContents:
    """Return the tuples in ``records`` that were not taken, in order, and the notes of taken tuples."""
    return RecordParser().parse(records)


def _parse_member(fields: object) -> Member | None:
    if not isinstance(fields, list) or len(fields) != 4:
        return None
    contact, incarnation = contact_unpacked(fields[:3]), fields[3]
    if contact is None or not isinstance(incarnation, bytes) or len(incarnation) != INCARNATION_BYTES:
        return None
    return Member(contact, incarnation)
