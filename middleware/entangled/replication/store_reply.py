"""The reply of a replica to the request to store a record; without I/O."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from middleware.entangled.record import Record

MAX_SEQUENCE = 2**62
"""The highest sequence number in a valid reply; with a higher number, an owner would soon have no numbers left."""


class Outcome(Enum):
    """The result of a request to store; the value is its code on the wire, except for SUPERSEDED."""

    STORED = 0
    SUPERSEDED = 1
    """The slot contains a record with the same or a higher sequence number; this number is the code on the wire."""
    FORGED = -1
    """The signature is wrong, or the sender may not store this record."""
    UNSYNCED = -2
    """The record was stored by a replica that has not caught up with the others; the reply is not counted as a vote."""
    FORBIDDEN = -3
    """The certificate of the owner does not allow the record, or is missing."""
    NO_ROOM = -4
    """The owner has the maximum number of records; this code is used only in an answer about several records."""


class StoreReply(NamedTuple):
    """The ``outcome`` and, if it is SUPERSEDED, the ``sequence`` of the record in the slot."""

    outcome: Outcome
    sequence: int = 0

    @property
    def is_stored(self) -> bool:
        """Whether the replica stores the record."""
        return self.outcome in (Outcome.STORED, Outcome.UNSYNCED)

    def encode(self) -> int:
        """Return the code of the reply on the wire."""
        return self.sequence if self.outcome is Outcome.SUPERSEDED else self.outcome.value


STORED = StoreReply(Outcome.STORED)
UNSYNCED = StoreReply(Outcome.UNSYNCED)
_REPLIES_BY_CODE = {each.value: StoreReply(each) for each in Outcome if each is not Outcome.SUPERSEDED}


def decode_reply(code: object, record: Record) -> StoreReply | None:
    """Return the reply about ``record`` that ``encode`` has encoded as ``code``, or None if ``code`` is invalid."""
    if type(code) is not int:
        return None
    if code > 0:
        is_valid = record.sequence <= code < MAX_SEQUENCE
        return StoreReply(Outcome.SUPERSEDED, code) if is_valid else None
    return _REPLIES_BY_CODE.get(code)
