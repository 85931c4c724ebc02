"""Message: what travels inside a sealed datagram, as strict msgpack.

``decoded`` is total: it gives a message or raises ``Malformed``, whatever the bytes.  Moments never travel.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgpack

from middleware.entangled.errors import Malformed
from middleware.entangled.network.network import MAX_DATAGRAM

MAX_METHOD = 64
MAX_TEXT = 300
MAX_DEPTH = 16
_QUESTION, _ANSWER, _FAILURE, _TOLD = range(4)


@dataclass(frozen=True, slots=True)
class Question:
    """Asks for ``method``; ``id`` (64 bits) is the asker's and tells a repeated question from a new one."""

    id: int
    method: str
    arguments: tuple[object, ...]


@dataclass(frozen=True, slots=True)
class Answer:
    """What the method returned."""

    id: int
    value: object


@dataclass(frozen=True, slots=True)
class Failure:
    """Why there is no value; ``code`` is one of ``REFUSED``, ``UNKNOWN_METHOD``, ``BAD_ARGUMENTS``, ``INTERNAL``."""

    id: int
    code: int
    text: str


@dataclass(frozen=True, slots=True)
class Told:
    """Calls ``method`` without an answer."""

    method: str
    arguments: tuple[object, ...]


REFUSED, UNKNOWN_METHOD, BAD_ARGUMENTS, INTERNAL = range(1, 5)

Message = Question | Answer | Failure | Told


def encoded(message: Message) -> bytes:
    """The bytes of ``message``; raises ``TypeError``, ``ValueError`` or ``OverflowError`` for what cannot be packed."""
    match message:
        case Question(id=number, method=method, arguments=arguments):
            fields = [_QUESTION, number, method, arguments]
        case Answer(id=number, value=value):
            fields = [_ANSWER, number, value]
        case Failure(id=number, code=code, text=text):
            fields = [_FAILURE, number, code, text[:MAX_TEXT]]
        case Told(method=method, arguments=arguments):
            fields = [_TOLD, method, arguments]
    return bytes(msgpack.packb(fields))


def decoded(data: bytes) -> Message:
    """The message that the bytes hold; raises ``Malformed`` and nothing else."""
    try:
        fields = msgpack.unpackb(
            data,
            strict_map_key=True,
            ext_hook=_no_extension,
            max_str_len=MAX_DATAGRAM,
            max_bin_len=MAX_DATAGRAM,
            max_array_len=MAX_DATAGRAM,
            max_map_len=MAX_DATAGRAM,
            max_ext_len=0,
        )
    except Exception as error:  # foreign code on foreign bytes; more kinds than its manual names have been seen
        raise Malformed(f"not msgpack: {type(error).__name__}") from None
    if not (isinstance(fields, list) and fields and type(fields[0]) is int):  # True and 1.0 would match 1
        raise Malformed("no message starts like this")
    match fields:
        case [0, id_, method, list(arguments)] if _is_id(id_) and _is_method(method) and _is_flat(arguments):
            return Question(id_, method, tuple(arguments))
        case [1, id_, value] if _is_id(id_) and _is_flat(value):
            return Answer(id_, value)
        case [2, id_, code, str(text)] if _is_id(id_) and _is_code(code) and len(text) <= MAX_TEXT:
            return Failure(id_, code, text)
        case [3, method, list(arguments)] if _is_method(method) and _is_flat(arguments):
            return Told(method, tuple(arguments))
    raise Malformed("no message has this shape")


def _no_extension(code: int, data: bytes) -> object:
    raise Malformed("extension types are not part of the protocol")


def _is_id(value: object) -> bool:
    return type(value) is int and 0 <= value < 2**64


def _is_code(value: object) -> bool:
    return type(value) is int and 0 <= value < 256


def _is_method(value: object) -> bool:
    return isinstance(value, str) and 0 < len(value) <= MAX_METHOD


def _is_flat(value: object) -> bool:
    """Whether nothing is nested deeper than ``MAX_DEPTH``, and nothing is a type that we do not send."""
    level: list[object] = [value]
    for _ in range(MAX_DEPTH):
        below: list[object] = []
        for item in level:
            if isinstance(item, list):
                below += item
            elif isinstance(item, dict):
                below += item.values()
            elif isinstance(item, msgpack.Timestamp):
                return False
        if not below:
            return True
        level = below
    return False
