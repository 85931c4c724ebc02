"""Auction: one round of bidding for one task, as its messages name it; pure.

It travels in the head of each message, so that a node on the way needs no record of the task, and each bid is signed
together with it: nobody can carry a bid over to another task, epoch, strategy or council.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import msgpack

from middleware.entangled.contact import Contact, unpacked
from middleware.entangled.record import MAX_NAME, hashed_key
from middleware.entangled.value import is_number, is_whole

MAX_COUNCIL = 9
MAX_STRATEGY = 64
MAX_WAITING = 600.0


@dataclass(frozen=True)
class Auction:
    """The bidding for ``task_id`` in ``epoch``, decided by ``strategy`` and announced by one of ``council``.

    ``waiting`` is the waiting period in seconds, counted from the first bid; an ``exclusive`` one is never flooded.
    """

    task_id: str
    epoch: int
    council: tuple[Contact, ...]
    strategy: str = "nearest"
    waiting: float = 0.5
    exclusive: bool = True

    @cached_property
    def key(self) -> bytes:
        """Where in the ring of ids the bids are going: the key of the task's group."""
        return hashed_key(f"task/{self.task_id}")

    @cached_property
    def digest(self) -> bytes:
        """What tells this auction from every other, in 16 bytes."""
        return hashlib.blake2s(msgpack.packb(self.packed()), digest_size=16).digest()

    def rank(self, node_id: bytes) -> int | None:
        """The place of a node in the council, 0 for its first member, or None where it is no member."""
        return next((place for place, member in enumerate(self.council) if member.node_id == node_id), None)

    def packed(self) -> list[object]:
        """The auction as it stands in a message."""
        council = [contact.packed() for contact in self.council]
        return [self.task_id, self.epoch, council, self.strategy, float(self.waiting), self.exclusive]


def auction_of(fields: object) -> Auction | None:
    """The auction that ``packed`` made, or None where the fields cannot be one; never raises."""
    if not isinstance(fields, list) or len(fields) != 6:
        return None
    task_id, epoch, council, strategy, waiting, exclusive = fields
    if not isinstance(council, list) or not 0 < len(council) <= MAX_COUNCIL:
        return None
    members = [contact for each in council if (contact := unpacked(each)) is not None]
    lawful = (
        isinstance(task_id, str)
        and 0 < len(task_id) <= MAX_NAME
        and is_whole(epoch)
        and len({member.node_id for member in members}) == len(council)
        and isinstance(strategy, str)
        and 0 < len(strategy) <= MAX_STRATEGY
        and is_number(waiting)
        and 0 <= waiting <= MAX_WAITING
        and isinstance(exclusive, bool)
    )
    return Auction(task_id, epoch, tuple(members), strategy, float(waiting), exclusive) if lawful else None
