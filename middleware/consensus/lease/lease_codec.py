"""Encode leases in messages (``lease.*``) and in notes of the store; no decoder raises an exception.

Messages carry durations, not times of day (PaxosLease, arXiv 1209.4187).
"""

from __future__ import annotations

import zlib

import msgpack

from middleware.entangled.contact import Contact, parse_contact
from middleware.entangled.quorum.acceptor_log import Codec, Floor
from middleware.entangled.quorum.ballot import NO_BALLOT, Ballot, Ceiling, is_number
from middleware.entangled.quorum.register import Register, Reply, ReplyKind

MAX_COUNCIL = 7
MAX_PROOF_BYTES = 2**16
_BUCKETS = 64
BALLOT_MODULUS = 2**20
"""All ballot counters of an agent have the same random remainder modulo this number until the agent restarts."""
EARLY_PROMISE_SHARE = 0.2
"""The next lease may be promised at most this share of the ttl before the end of the current one."""


def pack_reply(reply: Reply) -> list[object]:
    """Encode a reply for a message; the proof is omitted if it is empty."""
    is_sealed = reply.kind is ReplyKind.SEALED
    ballot, members = (reply.accepted, reply.value) if is_sealed else (reply.promised, ())
    proof = [reply.proof] if reply.proof else []
    return [reply.kind.value, *ballot, reply.token, reply.remaining, reply.configuration, pack_members(members), *proof]


def parse_reply(answer: object) -> Reply | None:
    """Decode a reply; None if it is invalid; never raises."""
    if not isinstance(answer, list) or not 7 <= len(answer) <= 8:
        return None
    name, counter, agent, token, remaining, configuration, packed = answer[:7]
    proof = answer[7] if len(answer) > 7 else b""
    kind = next((kind for kind in ReplyKind if kind.value == name), None)
    members = parse_members(packed)
    is_valid = (
        all(map(is_number, (counter, token, configuration)))
        and isinstance(agent, str)
        and isinstance(remaining, float)
        and isinstance(proof, bytes)
    )
    if not is_valid or kind is None or members is None:
        return None
    # Negative values and NaN become 0.
    remaining = remaining if remaining > 0.0 else 0.0
    ballot = Ballot(counter, agent)
    accepted, value = (ballot, members) if kind is ReplyKind.SEALED else (NO_BALLOT, None)
    return Reply(kind, ballot, token, remaining, configuration, accepted, value, proof)


def pack_members(members: tuple[Contact, ...]) -> list[list[object]]:
    """Encode the members of a council."""
    return [member.pack() for member in members]


def parse_members(packed: object) -> tuple[Contact, ...] | None:
    """Decode the members of a council; None if they are invalid."""
    if not isinstance(packed, list) or len(packed) > MAX_COUNCIL:
        return None
    members = tuple(contact for fields in packed if (contact := parse_contact(fields)) is not None)
    return members if len(members) == len(packed) == len({member.public for member in members}) else None


def _bucket_of(key: str) -> str:
    return f"lease/{zlib.crc32(key.encode()) % _BUCKETS}"


def _pack(registers: dict[str, Register]) -> bytes:
    return bytes(msgpack.packb({task_id: _pack_row(register) for task_id, register in registers.items()}))


def _unpack(noted: bytes) -> tuple[dict[str, Register], bool]:
    rows = unpack_note(noted)
    if not isinstance(rows, dict):
        return {}, False
    read = {task_id: parse_row(row) for task_id, row in rows.items()}
    valid = {task_id: each for task_id, each in read.items() if each is not None and isinstance(task_id, str)}
    return valid, len(valid) == len(rows)


def _pack_floor(floor: Floor) -> bytes:
    return bytes(msgpack.packb([floor.counter, floor.longest, floor.token]))


def _unpack_floor(noted: bytes | None) -> Floor | None:
    state = unpack_note(noted or b"")
    if isinstance(state, list) and len(state) == 2:
        state = [*state, state[0]]  # an older version wrote this note, with one floor for counter and token
    if not isinstance(state, list) or len(state) != 3:
        return None
    counter, longest, token = state
    is_valid = isinstance(longest, float) and is_number(counter) and is_number(token)
    return Floor(counter, token, longest) if is_valid else None


def parse_row(row: object) -> Register | None:
    """Decode the register of one task from a note, or return None if the note is invalid; never raises."""
    if not isinstance(row, list) or not 6 <= len(row) <= 8:
        return None
    configuration, ballots, token, ttl, packed, is_over = row[:6]
    proof = row[6] if len(row) > 6 else b""  # older versions did not write a proof
    if not isinstance(ballots, list) or len(ballots) != 8:
        return None
    # Older versions wrote the grantee only as the holder of an unreleased lease.
    grantee = row[7] if len(row) > 7 else ballots[3]
    members = parse_members(packed)
    is_valid = (
        all(map(is_number, (configuration, token, *ballots[::2])))
        and all(isinstance(agent, str) for agent in (*ballots[1::2], grantee))
        and isinstance(ttl, float)
        and isinstance(is_over, bool)
        and isinstance(proof, bytes)
        and len(proof) <= MAX_PROOF_BYTES
    )
    if not is_valid or members is None:
        return None
    promised, holder, spent, accepted = (Ballot(ballots[n], ballots[n + 1]) for n in range(0, 8, 2))
    return Register(
        Ceiling(0.0, BALLOT_MODULUS), configuration, promised, holder, spent, accepted, token, grantee, ttl,
        value=members, is_closed=is_over, proof=proof,
    )  # fmt: skip


def unpack_note(noted: bytes) -> object:
    """Decode msgpack; None if the bytes are invalid."""
    try:
        return msgpack.unpackb(noted, strict_map_key=True, max_ext_len=0)
    except Exception:  # msgpack raises many types on malformed bytes
        return None


def _pack_row(register: Register) -> list[object]:
    ballots = [*register.promised, *register.holder, *register.released, *register.accepted]
    members, grantee = pack_members(register.value or ()), register.grantee
    token, ttl = register.token, register.ttl
    return [register.configuration, ballots, token, ttl, members, register.is_closed, register.proof, grantee]


CODEC: Codec[str] = Codec(
    "lease/state",
    "lease/{}",
    _BUCKETS,
    "",
    BALLOT_MODULUS,
    _bucket_of,
    _pack,
    _unpack,
    _pack_floor,
    _unpack_floor,
)
