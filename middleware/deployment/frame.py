"""The messages between a node and the process that runs a pushed module, and the channel that carries them; pure.

A question is ``[number, verb, arguments]``, its answer ``[number, is_well, content]``, each in msgpack behind its
length in four bytes.  The node trusts nothing in an answer: its size is limited before it is read, and its number has
to belong to an open question.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, Protocol

import msgpack

LOAD, MAKE, CALL, DROP = "load", "make", "call", "drop"
"""Verbs: load the module; make an instance; call a method of one; drop it."""
FIRST = 0
"""The instance of a strategy: strategies are pure, so one serves all tasks."""
MAX_QUESTION = 4 * 1024 * 1024
"""Bytes of a question: an observation with a picture, or a module's source."""
MAX_ANSWER = 64 * 1024
_LENGTH = struct.Struct("!I")


class BadFrame(ValueError):
    """Bytes that are no message, or too large a one."""


def pack(content: object) -> bytes:
    """A message with its length; raises ``BadFrame`` if ``content`` is no plain value."""
    try:
        packed = bytes(msgpack.packb(content))
    except Exception as error:  # msgpack raises many things
        raise BadFrame(f"is no plain value: {error}") from error
    return _LENGTH.pack(len(packed)) + packed


def unpack_question(message: bytes) -> tuple[int, str, list[Any]]:
    """A question; raises ``BadFrame``."""
    number, verb, arguments = _three(message)
    if not isinstance(verb, str) or not isinstance(arguments, list):
        raise BadFrame("is no question")
    return number, verb, arguments


def unpack_answer(message: bytes) -> tuple[int, bool, Any]:
    """An answer; raises ``BadFrame``."""
    number, is_well, content = _three(message)
    if not isinstance(is_well, bool):
        raise BadFrame("is no answer")
    return number, is_well, content


class Splitter:
    """Splits a stream into messages of at most ``limit`` bytes."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """The messages that are whole now, without their lengths; raises ``BadFrame`` for one that is too large."""
        self._rest += data
        found = []
        while len(self._rest) >= _LENGTH.size:
            (size,) = _LENGTH.unpack_from(self._rest)
            if size > self._limit:
                raise BadFrame(f"has {size} bytes, more than {self._limit}")
            end = _LENGTH.size + size
            if len(self._rest) < end:
                break
            found.append(self._rest[_LENGTH.size : end])
            self._rest = self._rest[end:]
        return found


def _three(message: bytes) -> tuple[int, Any, Any]:
    try:
        fields = msgpack.unpackb(message, use_list=True)
    except Exception as error:  # msgpack raises many things
        raise BadFrame(f"cannot be read: {error}") from error
    if not isinstance(fields, list) or len(fields) != 3 or type(fields[0]) is not int:
        raise BadFrame("has not three fields with a number first")
    return fields[0], fields[1], fields[2]


class Gone(Exception):
    """The process has ended, or said what no answer can be; the text says which."""


class Channel(Protocol):
    """The two pipes of a running process, as the node sees them; ``receive`` and ``send`` raise ``Gone``."""

    def send(self, message: bytes) -> None:
        """Send a message; the next ``receive`` sends the rest that the pipe does not take now."""

    @property
    def is_behind(self) -> bool:
        """Whether something is left to be sent."""

    def receive(self, within_s: float) -> list[bytes]:
        """The received messages; if there is none yet, wait for one at most ``within_s`` seconds."""

    def end(self) -> None:
        """End the process at once; may be called again."""


Spawn = Callable[[], Channel]
"""Starts a process that has no module yet."""
