"""Encoding of decisions about tuples in messages (``decree.*``) and in notes of the store; without I/O."""

from __future__ import annotations

import hashlib
from typing import Any

import msgpack

from middleware.entangled.quorum.acceptor import Event
from middleware.entangled.quorum.acceptor_log import Codec, Floor
from middleware.entangled.quorum.ballot import NO_BALLOT, Ballot, Ceiling
from middleware.entangled.quorum.register import Register, Reply, ReplyKind
from middleware.entangled.record import KEY_BYTES
from middleware.entangled.space.tuple_record import TupleId, is_taker_name, parse_tuple_id

MAX_COUNTER = 2**48
MAX_LEASE_S = 600.0
_GRANTED = {Event.PREPARE: 0, Event.ACCEPT: 1, Event.RELEASE: 5}
_OTHERS = {ReplyKind.HELD: 2, ReplyKind.OUTBID: 3, ReplyKind.UNPREPARED: 4}
_KINDS = {code: kind for kind, code in _OTHERS.items()}


def is_counter(value: object) -> bool:
    """Return whether ``value`` may be the counter of a ballot."""
    return type(value) is int and 0 < value < MAX_COUNTER


def is_lease(value: object) -> bool:
    """Return whether ``value`` may be the remaining seconds of a lease."""
    return type(value) is float and 0.0 <= value <= MAX_LEASE_S


def pack_reply(reply: Reply, event: Event) -> list[object]:
    """Encode the reply to ``event`` for a message."""
    code = _OTHERS.get(reply.kind, _GRANTED[event])
    return [
        code,
        reply.promised.counter,
        min(reply.remaining, MAX_LEASE_S),
        _pack_accepted(reply.accepted, reply.value),
    ]


def unpack_reply(fields: object, event: Event) -> Reply | None:
    """Decode the fields of ``pack_reply``; None if they are invalid."""
    if not isinstance(fields, list) or len(fields) != 4:
        return None
    code, counter, remaining, accepted = fields
    if type(code) is not int or not (is_counter(counter) or (type(counter) is int and counter == 0)):
        return None
    kind = ReplyKind.GRANTED if code == _GRANTED[event] else _KINDS.get(code)
    decoded = _unpack_accepted(accepted)
    if kind is None or not is_lease(remaining) or decoded is None:
        return None
    return Reply(kind, Ballot(counter, b""), remaining=remaining, accepted=decoded[0], value=decoded[1])


def _bucket_of(key: TupleId) -> str:
    return f"decree/{hashlib.blake2s(key.mark + key.owner, digest_size=1).hexdigest()}"


def _pack(registers: dict[TupleId, Register]) -> bytes:
    rows: list[list[Any]] = []
    for tuple_id, register in registers.items():
        accepted = _pack_accepted(register.accepted, register.value)
        rows.append([tuple_id.key, tuple_id.pack(), *register.promised, register.reserve, accepted])
    return bytes(msgpack.packb(rows))


def _unpack(noted: bytes) -> tuple[dict[TupleId, Register], bool]:
    try:
        rows = msgpack.unpackb(noted, strict_map_key=True, max_ext_len=0)
    except Exception:  # msgpack raises many types on corrupt bytes
        return {}, False
    pairs = [_unpack_row(row) for row in rows] if isinstance(rows, list) else [None]
    return dict(pair for pair in pairs if pair is not None), None not in pairs


def _pack_floor(floor: Floor) -> bytes:
    return floor.counter.to_bytes(8, "big")


def _unpack_floor(noted: bytes | None) -> Floor:
    return Floor(int.from_bytes(noted or b""))


def _unpack_row(row: object) -> tuple[TupleId, Register] | None:
    if not isinstance(row, list) or len(row) != 6 or not isinstance(row[0], bytes) or len(row[0]) != KEY_BYTES:
        return None
    key, fields, counter, taker, lease, accepted = row
    tuple_id, decoded = parse_tuple_id(key, fields), _unpack_accepted(accepted)
    if tuple_id is None or decoded is None or not (is_counter(counter) and is_taker_name(taker) and is_lease(lease)):
        return None
    ballot, value = decoded
    ceiling = Ceiling(0.0, 1)
    return tuple_id, Register(ceiling, promised=Ballot(counter, taker), accepted=ballot, value=value, reserve=lease)


def _pack_accepted(ballot: Ballot, value: object) -> list[object] | None:
    return None if ballot == NO_BALLOT else [*ballot, value]


def _unpack_accepted(fields: object) -> tuple[Ballot, bytes | None] | None:
    """Decode the accepted value and its ballot (``NO_BALLOT`` if no value was accepted); None if a field is invalid."""
    if fields is None:
        return NO_BALLOT, None
    if not isinstance(fields, list) or len(fields) != 3:
        return None
    counter, taker, value = fields
    return (
        (Ballot(counter, taker), value)
        if is_counter(counter) and is_taker_name(taker) and is_taker_name(value)
        else None
    )


CODEC: Codec[TupleId] = Codec(
    "decree/floor",
    "decree/{:02x}",
    256,
    b"",
    1,
    _bucket_of,
    _pack,
    _unpack,
    _pack_floor,
    _unpack_floor,
)
