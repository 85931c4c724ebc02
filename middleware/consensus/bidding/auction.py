"""An auction is one round of bidding for one task; pure.

Each message starts with the auction, so nodes that forward it need no record of the task.  The signature of a bid also
covers the auction, so no node can reuse the bid for a different task, epoch, strategy or quorum.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import msgpack

from middleware.entangled.contact import Contact, parse_contact
from middleware.entangled.record import MAX_NAME_BYTES, hash_key
from middleware.entangled.value import is_natural, is_number

MAX_COUNCIL = 9
MAX_STRATEGY_CHARACTERS = 64
MAX_WAITING_S = 600.0


@dataclass(frozen=True)
class Auction:
    """The bidding for ``task_id`` in ``epoch``, decided by ``strategy`` and announced by a member of ``council``.

    ``waiting_period`` is in seconds, from the first bid.  The bids of an ``exclusive`` auction are never flooded.
    """

    task_id: str
    epoch: int
    council: tuple[Contact, ...]
    strategy: str = "nearest"
    waiting_period: float = 0.5
    exclusive: bool = True

    @cached_property
    def key(self) -> bytes:
        """The key to which bids are forwarded: the key of the task's group."""
        return hash_key(f"task/{self.task_id}")

    @cached_property
    def digest(self) -> bytes:
        """A unique identifier of this auction, 16 bytes."""
        return hashlib.blake2s(msgpack.packb(self.pack()), digest_size=16).digest()

    def find_rank(self, node_id: bytes) -> int | None:
        """Return a node's index among the quorum members, or None if it is not a member."""
        return next((place for place, member in enumerate(self.council) if member.node_id == node_id), None)

    def pack(self) -> list[object]:
        """Return the encoding for messages."""
        council = [contact.pack() for contact in self.council]
        return [self.task_id, self.epoch, council, self.strategy, float(self.waiting_period), self.exclusive]


def parse_auction(fields: object) -> Auction | None:
    """Decode an auction; None if it is malformed.  Never raises."""
    if not isinstance(fields, list) or len(fields) != 6:
        return None
    task_id, epoch, council, strategy, waiting, exclusive = fields
    if not isinstance(council, list) or not 0 < len(council) <= MAX_COUNCIL:
        return None
    members = [contact for each in council if (contact := parse_contact(each)) is not None]
    is_valid = (
        isinstance(task_id, str)
        and 0 < len(task_id) <= MAX_NAME_BYTES
        and is_natural(epoch)
        and len({member.node_id for member in members}) == len(council)
        and isinstance(strategy, str)
        and 0 < len(strategy) <= MAX_STRATEGY_CHARACTERS
        and is_number(waiting)
        and 0 <= waiting <= MAX_WAITING_S
        and isinstance(exclusive, bool)
    )
    return Auction(task_id, epoch, tuple(members), strategy, float(waiting), exclusive) if is_valid else None
