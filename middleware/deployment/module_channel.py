"""Messages and channel between a node and the process of a pushed module.  Pure.

A request is ``[number, verb, arguments]`` and its reply ``[number, is_well, content]``, in msgpack with a 4-byte length
prefix.  The node does not trust replies: it limits their size before parsing, and the number must be the number of a
pending request.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, Protocol

import msgpack

LOAD, MAKE, CALL, DROP = "load", "make", "call", "drop"
"""Verbs: load the module; create an instance; call a method of an instance; delete it."""
STRATEGY_INSTANCE = 0
"""The number of a strategy's instance: strategies are pure, so one instance serves all tasks."""
MAX_REQUEST_BYTES = 4 * 1024 * 1024
"""Maximum size of a request in bytes; the largest are an observation with a picture and a module's source."""
MAX_REPLY_BYTES = 64 * 1024
_LENGTH = struct.Struct("!I")


class BadFrame(ValueError):
    """The bytes are not a valid message, or exceed the size limit."""


def pack(content: object) -> bytes:
    """Pack a message with its length prefix; raises ``BadFrame`` if ``content`` is not a plain value."""
    try:
        packed = bytes(msgpack.packb(content))
    except Exception as error:  # msgpack raises many things
        raise BadFrame(f"is not a plain value: {error}") from error
    return _LENGTH.pack(len(packed)) + packed


def parse_request(message: bytes) -> tuple[int, str, list[Any]]:
    """Parse a request; raises ``BadFrame``."""
    number, verb, arguments = _parse_message(message)
    if not isinstance(verb, str) or not isinstance(arguments, list):
        raise BadFrame("is not a valid request")
    return number, verb, arguments


def parse_reply(message: bytes) -> tuple[int, bool, Any]:
    """Parse a reply; raises ``BadFrame``."""
    number, is_well, content = _parse_message(message)
    if not isinstance(is_well, bool):
        raise BadFrame("is not a valid reply")
    return number, is_well, content


class FrameSplitter:
    """Split a byte stream into messages of at most ``limit`` bytes."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the messages that are complete now, without prefixes; raises ``BadFrame`` if one is too large."""
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


def _parse_message(message: bytes) -> tuple[int, Any, Any]:
    try:
        fields = msgpack.unpackb(message, use_list=True)
    except Exception as error:  # msgpack raises many things
        raise BadFrame(f"is not msgpack: {error}") from error
    if not isinstance(fields, list) or len(fields) != 3 or type(fields[0]) is not int:
        raise BadFrame("does not have three fields with a number first")
    return fields[0], fields[1], fields[2]


class ProcessEnded(Exception):
    """The process has ended or sent an invalid reply; the text is the reason."""


class Channel(Protocol):
    """The node's end of the two pipes of a process; ``receive`` and ``send`` raise ``ProcessEnded``."""

    def send(self, message: bytes) -> None:
        """Send a message; the next ``receive`` sends the part that does not fit into the pipe now."""

    @property
    def has_unsent(self) -> bool:
        """Whether a part of a message is not sent yet."""

    def receive(self, within_s: float) -> list[bytes]:
        """Return the received messages; if there is none, wait for one for at most ``within_s`` seconds."""

    def kill(self) -> None:
        """Kill the process; may be called again."""


Spawn = Callable[[], Channel]
"""Starts a process without a module."""
