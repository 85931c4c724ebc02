"""The charter of a task: the chain of signatures that proves the members of its council; pure.

The node that publishes a task signs its first council.  Every member that accepts a change of the council signs the
change, so a majority of each council certifies the next council, and no single node can choose it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import msgpack

from middleware.consensus.lease.lease_codec import (
    MAX_COUNCIL,
    MAX_PROOF_BYTES,
    pack_members,
    parse_members,
    unpack_note,
)
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Refused
from middleware.entangled.identity import Identity, is_signature_valid
from middleware.entangled.quorum.ballot import (
    FIRST_CONFIGURATION,
    INITIAL_CEILING,
    NO_BALLOT,
    Ballot,
    is_number,
    majority,
)
from middleware.entangled.quorum.register import Reply

MAX_CHANGES = 64
"""Maximum number of changes of one task's council; a change to three members takes 350 bytes, to seven members 700."""
MIN_MEMBERS = 3
"""Minimum number of members after a change; in a smaller council, a single member could be a majority."""
MAX_TOKEN = 2 * INITIAL_CEILING
"""Upper bound of the token with which a new council starts, so that no single member can exhaust the tokens."""
SIGNATURE_BYTES = 64

Votes = tuple[tuple[int, int, bytes], ...]
"""For each member that signed: its index in the council, its highest token, and its signature."""


class CouncilChange(NamedTuple):
    """One change: the ``members`` of the next council, and the ``votes`` of the previous council under ``ballot``."""

    members: tuple[Contact, ...]
    ballot: Ballot
    votes: Votes


@dataclass(frozen=True)
class Charter:
    """The first council of a task, signed by ``owner``, and the changes of the council, the oldest first."""

    owner: bytes
    first: tuple[Contact, ...]
    signature: bytes
    changes: tuple[CouncilChange, ...] = ()

    @property
    def configuration(self) -> int:
        """The number of the newest council."""
        return FIRST_CONFIGURATION + len(self.changes)

    @property
    def members(self) -> tuple[Contact, ...]:
        """The newest council."""
        return self.changes[-1].members if self.changes else self.first

    @property
    def ballot(self) -> Ballot:
        """The ballot under which the newest council was chosen."""
        return self.changes[-1].ballot if self.changes else NO_BALLOT

    @property
    def token(self) -> int:
        """The token above which the newest council grants leases."""
        return min(MAX_TOKEN, max((token for change in self.changes for _, token, _ in change.votes), default=0))

    @property
    def first_council_id(self) -> tuple[bytes, bytes]:
        """The identity of the first council: its owner and signature."""
        return self.owner, self.signature

    def with_change(self, members: tuple[Contact, ...], ballot: Ballot, votes: Votes) -> Charter:
        """Return this charter with one more council; raise ``Refused`` after ``MAX_CHANGES`` changes."""
        if len(self.changes) >= MAX_CHANGES:
            raise Refused(f"the council has changed {MAX_CHANGES} times; ask the operator to submit the task again")
        return replace(self, changes=(*self.changes, CouncilChange(members, ballot, votes)))

    def is_genuine(self, task_id: str) -> bool:
        """Return whether all signatures are valid; whether ``owner`` may publish tasks is not checked."""
        return _is_genuine(self.packed, task_id)

    @cached_property
    def packed(self) -> bytes:
        """The encoding for messages, records and notes."""
        changes = [
            [pack_members(change.members), *change.ballot, [list(vote) for vote in change.votes]]
            for change in self.changes
        ]
        return bytes(msgpack.packb([self.owner, pack_members(self.first), self.signature, changes]))


def create_charter(identity: Identity, task_id: str, members: tuple[Contact, ...]) -> Charter:
    """Return the charter of a new task with the first council ``members``."""
    return Charter(identity.public, members, identity.sign(_first_council_bytes(task_id, members)))


def sign_change(
    identity: Identity, task_id: str, configuration: int, ballot: Ballot, members: tuple[Contact, ...], token: int
) -> bytes:
    """Sign the change from ``configuration`` to the council ``members``, and the highest granted ``token``."""
    return identity.sign(_change_bytes(task_id, configuration, ballot, members, token))


def sign_end(identity: Identity, task_id: str, configuration: int, agent: str, token: int) -> bytes:
    """Sign that ``agent`` closed the task under ``token``, the token of its lease."""
    return identity.sign(_end_bytes(task_id, configuration, agent, token))


def parse_charter(packed: object) -> Charter | None:
    """Decode a charter without checking its signatures; None if it is malformed; never raises."""
    return _parse_charter(packed) if isinstance(packed, bytes) and 0 < len(packed) <= MAX_PROOF_BYTES else None


def is_change_signed(
    member: Contact, task_id: str, configuration: int, ballot: Ballot, members: tuple[Contact, ...], reply: Reply
) -> bool:
    """Return whether ``reply`` contains a valid signature of ``member`` for the change (``sign_change``)."""
    statement = _change_bytes(task_id, configuration, ballot, members, reply.token)
    return is_signature_valid(member.public, statement, reply.proof)


def is_end_signed(member: Contact, task_id: str, configuration: int, agent: str, token: int, proof: bytes) -> bool:
    """Return whether ``proof`` is a valid signature of ``member`` for the end of the task (``sign_end``)."""
    return is_signature_valid(member.public, _end_bytes(task_id, configuration, agent, token), proof)


@dataclass(frozen=True)
class EndProof:
    """The proof that a task was closed under a token, signed by a majority of the council of ``charter``."""

    charter: Charter
    signatures: tuple[tuple[int, bytes], ...]

    def is_genuine(self, task_id: str, agent: str, token: int) -> bool:
        """Return whether a majority has signed that ``agent`` closed the task under ``token``."""
        members = self.charter.members
        statement = _end_bytes(task_id, self.charter.configuration, agent, token)
        return self.charter.is_genuine(task_id) and _is_majority(
            members, {place: (statement, signature) for place, signature in self.signatures}
        )

    @property
    def packed(self) -> bytes:
        """The encoding for a record; an unchanged charter is omitted, because the task's record contains it."""
        charter = self.charter.packed if self.charter.changes else b""
        return bytes(msgpack.packb([charter, [list(each) for each in self.signatures]]))


def parse_end_proof(packed: object, pinned: Charter) -> EndProof | None:
    """Decode the proof for the task published with the charter ``pinned``; None if it is malformed; never raises."""
    fields = unpack_note(packed) if isinstance(packed, bytes) and len(packed) <= 2 * MAX_PROOF_BYTES else None
    if not isinstance(fields, list) or len(fields) != 2 or not isinstance(fields[1], list):
        return None
    charter, signatures = parse_charter(fields[0]) if fields[0] else pinned, fields[1]
    if charter is None or charter.first_council_id != pinned.first_council_id or len(signatures) > MAX_COUNCIL:
        return None
    if not all(isinstance(each, list) and len(each) == 2 and _is_vote(each[0], 0, each[1]) for each in signatures):
        return None
    return EndProof(charter, tuple((place, signature) for place, signature in signatures))


class CharterVerifier:
    """Checks charters from peers; ``may_publish`` returns whether the owner of a key may publish the task."""

    def __init__(self, may_publish: Callable[[bytes, str], bool]) -> None:
        self._may_publish = may_publish

    def parse(self, task_id: str, packed: object) -> Charter | None:
        """Decode and check the charter of ``task_id``; None if any part of it is invalid."""
        charter = parse_charter(packed)
        if charter is None or not self._may_publish(charter.owner, task_id) or not charter.is_genuine(task_id):
            return None
        return charter


# -- inside ---------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=64)  # checking takes 80 us per signature, and the same charter is checked repeatedly
def _is_genuine(packed: bytes, task_id: str) -> bool:
    charter = _parse_charter(packed)
    if charter is None or not is_signature_valid(
        charter.owner, _first_council_bytes(task_id, charter.first), charter.signature
    ):
        return False
    previous, configuration = charter.first, FIRST_CONFIGURATION
    for members, ballot, votes in charter.changes:
        statements = {
            place: (_change_bytes(task_id, configuration, ballot, members, token), signature)
            for place, token, signature in votes
        }
        if len(members) < MIN_MEMBERS or not _is_majority(previous, statements):
            return False
        previous, configuration = members, configuration + 1
    return True


def _is_majority(members: tuple[Contact, ...], signed: Mapping[int, tuple[bytes, bytes]]) -> bool:
    """Return whether a majority of ``members`` has signed.

    ``signed`` maps the index of a member to its statement and signature.
    """
    if len(signed) < majority(len(members)) or any(place >= len(members) for place in signed):
        return False
    return all(is_signature_valid(members[place].public, *pair) for place, pair in signed.items())


@lru_cache(maxsize=64)
def _parse_charter(packed: bytes) -> Charter | None:
    fields = unpack_note(packed)
    if not isinstance(fields, list) or len(fields) != 4:
        return None
    owner, first, signature, rows = fields
    members = parse_members(first)
    if not members or not _is_bytes(owner, 32) or not _is_bytes(signature, SIGNATURE_BYTES):
        return None
    if not isinstance(rows, list) or len(rows) > MAX_CHANGES:
        return None
    changes = [_parse_change(row) for row in rows]
    valid = tuple(change for change in changes if change is not None)
    return Charter(owner, members, signature, valid) if len(valid) == len(changes) else None


def _parse_change(row: Any) -> CouncilChange | None:
    if not isinstance(row, list) or len(row) != 4 or not isinstance(row[3], list) or len(row[3]) > MAX_COUNCIL:
        return None
    packed, counter, agent, votes = row
    members = parse_members(packed)
    if not members or not is_number(counter) or not isinstance(agent, str):
        return None
    if not all(isinstance(vote, list) and len(vote) == 3 and _is_vote(*vote) for vote in votes):
        return None
    return CouncilChange(
        members, Ballot(counter, agent), tuple((place, token, signature) for place, token, signature in votes)
    )


def _is_vote(place: object, token: object, signature: object) -> bool:
    return is_number(place) and is_number(token) and _is_bytes(signature, SIGNATURE_BYTES)


def _is_bytes(value: object, size: int) -> bool:
    return isinstance(value, bytes) and len(value) == size


def _first_council_bytes(task_id: str, members: tuple[Contact, ...]) -> bytes:
    return bytes(msgpack.packb([b"swarm-council-1", task_id, FIRST_CONFIGURATION, pack_members(members)]))


def _change_bytes(task_id: str, configuration: int, ballot: Ballot, members: tuple[Contact, ...], token: int) -> bytes:
    fields = [b"swarm-council-change-1", task_id, configuration, *ballot, pack_members(members), token]
    return bytes(msgpack.packb(fields))


def _end_bytes(task_id: str, configuration: int, agent: str, token: int) -> bytes:
    return bytes(msgpack.packb([b"swarm-task-end-1", task_id, configuration, agent, token]))
