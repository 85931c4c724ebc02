"""The signed chain of a task's quorum members (charter); pure.

The node that publishes the task signs the first members.  Each change is certified by a majority of the previous
members: every member that accepts it signs it.  So no single node can appoint quorum members.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import msgpack

from middleware.consensus.lease.lease_codec import MAX_COUNCIL, MAX_PROOF_BYTES, members_of, pack_members, unpack_note
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Refused
from middleware.entangled.identity import Identity, verified
from middleware.entangled.quorum.ballot import FIRST, NONE, ROOM, Ballot, is_number, majority
from middleware.entangled.quorum.register import Reply

MAX_LINKS = 64
"""Maximum number of changes for one task; a change of three members takes 350 bytes, one of seven 700."""
LEAST = 3
"""Minimum number of members after a change: in a smaller set one member would be a majority."""
MAX_TOKEN = 2 * ROOM
"""Upper bound of the token of a new configuration, against a false token from one previous member."""
SIGNATURE_BYTES = 64

Votes = tuple[tuple[int, int, bytes], ...]
"""For each member that signed: its index among the members, its highest token, and its signature."""


class Link(NamedTuple):
    """One change: the new ``members``, and the votes of the previous members under ``ballot``."""

    members: tuple[Contact, ...]
    ballot: Ballot
    votes: Votes


@dataclass(frozen=True)
class Charter:
    """The first quorum members of a task, signed by ``owner``, and their changes, the oldest first."""

    owner: bytes
    first: tuple[Contact, ...]
    signature: bytes
    links: tuple[Link, ...] = ()

    @property
    def configuration(self) -> int:
        """The number of the newest configuration."""
        return FIRST + len(self.links)

    @property
    def members(self) -> tuple[Contact, ...]:
        """The members of the newest configuration."""
        return self.links[-1].members if self.links else self.first

    @property
    def ballot(self) -> Ballot:
        """The ballot under which the newest members were chosen."""
        return self.links[-1].ballot if self.links else NONE

    @property
    def token(self) -> int:
        """The token above which the newest members grant leases."""
        return min(MAX_TOKEN, max((token for link in self.links for _, token, _ in link.votes), default=0))

    @property
    def pin(self) -> tuple[bytes, bytes]:
        """The key that distinguishes charters with different first members."""
        return self.owner, self.signature

    def extended(self, members: tuple[Contact, ...], ballot: Ballot, votes: Votes) -> Charter:
        """Return this charter with one more change; raises ``Refused`` after ``MAX_LINKS`` changes."""
        if len(self.links) >= MAX_LINKS:
            raise Refused(f"the quorum members have changed {MAX_LINKS} times; have the operator create the task again")
        return replace(self, links=(*self.links, Link(members, ballot, votes)))

    def is_genuine(self, task_id: str) -> bool:
        """Return whether all signatures are valid; whether ``owner`` may publish tasks is checked separately."""
        return _is_genuine(self.packed, task_id)

    @cached_property
    def packed(self) -> bytes:
        """The encoding of the charter in messages, records and the store."""
        links = [[pack_members(link.members), *link.ballot, [list(vote) for vote in link.votes]] for link in self.links]
        return bytes(msgpack.packb([self.owner, pack_members(self.first), self.signature, links]))


def pin(identity: Identity, task_id: str, members: tuple[Contact, ...]) -> Charter:
    """Return the charter of a new task with the first ``members``."""
    return Charter(identity.public, members, identity.sign(_pin_statement(task_id, members)))


def sign_change(
    identity: Identity, task_id: str, configuration: int, ballot: Ballot, members: tuple[Contact, ...], token: int
) -> bytes:
    """Sign the acceptance of ``members`` as the next configuration, and the highest token granted."""
    return identity.sign(_change_statement(task_id, configuration, ballot, members, token))


def sign_end(identity: Identity, task_id: str, configuration: int, agent: str, token: int) -> bytes:
    """Sign that ``agent`` closed the task under ``token``, which it was granted."""
    return identity.sign(_end_statement(task_id, configuration, agent, token))


def charter_of(packed: object) -> Charter | None:
    """Decode a charter without checking its signatures; None if it is malformed.  Never raises."""
    return _charter_of(packed) if isinstance(packed, bytes) and 0 < len(packed) <= MAX_PROOF_BYTES else None


def is_change_signed(
    member: Contact, task_id: str, configuration: int, ballot: Ballot, members: tuple[Contact, ...], reply: Reply
) -> bool:
    """Return whether ``reply`` has a valid signature of ``member`` for that change (``sign_change``)."""
    statement = _change_statement(task_id, configuration, ballot, members, reply.token)
    return verified(member.public, statement, reply.proof)


def is_end_signed(member: Contact, task_id: str, configuration: int, agent: str, token: int, proof: bytes) -> bool:
    """Return whether ``proof`` is a valid signature of ``member`` for that end (``sign_end``)."""
    return verified(member.public, _end_statement(task_id, configuration, agent, token), proof)


@dataclass(frozen=True)
class Ending:
    """The proof that a task was closed under a token: the signatures of a majority of the members of ``charter``."""

    charter: Charter
    signatures: tuple[tuple[int, bytes], ...]

    def is_genuine(self, task_id: str, agent: str, token: int) -> bool:
        """Return whether a majority signed that ``agent`` closed the task under ``token``."""
        members = self.charter.members
        statement = _end_statement(task_id, self.charter.configuration, agent, token)
        return self.charter.is_genuine(task_id) and _is_majority(
            members, {place: (statement, signature) for place, signature in self.signatures}
        )

    @property
    def packed(self) -> bytes:
        """The encoding of the proof in a record.

        A charter without changes is left out, since the task's record has it.
        """
        charter = self.charter.packed if self.charter.links else b""
        return bytes(msgpack.packb([charter, [list(each) for each in self.signatures]]))


def ending_of(packed: object, pinned: Charter) -> Ending | None:
    """Decode the proof for the task that was published with ``pinned``; None if it is malformed.  Never raises."""
    fields = unpack_note(packed) if isinstance(packed, bytes) and len(packed) <= 2 * MAX_PROOF_BYTES else None
    if not isinstance(fields, list) or len(fields) != 2 or not isinstance(fields[1], list):
        return None
    charter, signatures = charter_of(fields[0]) if fields[0] else pinned, fields[1]
    if charter is None or charter.pin != pinned.pin or len(signatures) > MAX_COUNCIL:
        return None
    if not all(isinstance(each, list) and len(each) == 2 and _is_vote(each[0], 0, each[1]) for each in signatures):
        return None
    return Ending(charter, tuple((place, signature) for place, signature in signatures))


class Judge:
    """Decodes and checks charters of other nodes; ``may_pin`` returns whether the owner of a key may publish a task."""

    def __init__(self, may_pin: Callable[[bytes, str], bool]) -> None:
        self._may_pin = may_pin

    def read(self, task_id: str, packed: object) -> Charter | None:
        """Return the charter of ``task_id`` in ``packed``, or None if any part of it is invalid."""
        charter = charter_of(packed)
        if charter is None or not self._may_pin(charter.owner, task_id) or not charter.is_genuine(task_id):
            return None
        return charter


# -- inside ---------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=64)  # a signature takes 80 us to check, and the same charter is read often
def _is_genuine(packed: bytes, task_id: str) -> bool:
    charter = _charter_of(packed)
    if charter is None or not verified(charter.owner, _pin_statement(task_id, charter.first), charter.signature):
        return False
    before, configuration = charter.first, FIRST
    for members, ballot, votes in charter.links:
        statements = {
            place: (_change_statement(task_id, configuration, ballot, members, token), signature)
            for place, token, signature in votes
        }
        if len(members) < LEAST or not _is_majority(before, statements):
            return False
        before, configuration = members, configuration + 1
    return True


def _is_majority(members: tuple[Contact, ...], signed: Mapping[int, tuple[bytes, bytes]]) -> bool:
    """Return whether a majority of ``members`` signed, each the statement at its index."""
    if len(signed) < majority(len(members)) or any(place >= len(members) for place in signed):
        return False
    return all(verified(members[place].public, *pair) for place, pair in signed.items())


@lru_cache(maxsize=64)
def _charter_of(packed: bytes) -> Charter | None:
    fields = unpack_note(packed)
    if not isinstance(fields, list) or len(fields) != 4:
        return None
    owner, first, signature, rows = fields
    members = members_of(first)
    if not members or not _is_bytes(owner, 32) or not _is_bytes(signature, SIGNATURE_BYTES):
        return None
    if not isinstance(rows, list) or len(rows) > MAX_LINKS:
        return None
    links = [_link_of(row) for row in rows]
    known = tuple(link for link in links if link is not None)
    return Charter(owner, members, signature, known) if len(known) == len(links) else None


def _link_of(row: Any) -> Link | None:
    if not isinstance(row, list) or len(row) != 4 or not isinstance(row[3], list) or len(row[3]) > MAX_COUNCIL:
        return None
    packed, counter, agent, votes = row
    members = members_of(packed)
    if not members or not is_number(counter) or not isinstance(agent, str):
        return None
    if not all(isinstance(vote, list) and len(vote) == 3 and _is_vote(*vote) for vote in votes):
        return None
    return Link(members, Ballot(counter, agent), tuple((place, token, signature) for place, token, signature in votes))


def _is_vote(place: object, token: object, signature: object) -> bool:
    return is_number(place) and is_number(token) and _is_bytes(signature, SIGNATURE_BYTES)


def _is_bytes(value: object, size: int) -> bool:
    return isinstance(value, bytes) and len(value) == size


def _pin_statement(task_id: str, members: tuple[Contact, ...]) -> bytes:
    return bytes(msgpack.packb([b"swarm-council-1", task_id, FIRST, pack_members(members)]))


def _change_statement(
    task_id: str, configuration: int, ballot: Ballot, members: tuple[Contact, ...], token: int
) -> bytes:
    fields = [b"swarm-council-change-1", task_id, configuration, *ballot, pack_members(members), token]
    return bytes(msgpack.packb(fields))


def _end_statement(task_id: str, configuration: int, agent: str, token: int) -> bytes:
    return bytes(msgpack.packb([b"swarm-task-end-1", task_id, configuration, agent, token]))
