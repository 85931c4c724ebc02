"""The stops that a node knows, and the releases that ended some of them.  Pure.

A *stop* is one emergency stop order, with a random id; a *release* contains the ids of the stops that it ends.  A stop
is in force until it is released, and the team is stopped as long as any stop is in force.  Stops and releases are
merged as in a two-phase set: the order and repetition of messages make no difference, and a released stop never comes
into force again.  Stops are not numbered, so a sender cannot make later stops ineffective with a high number.

Each sender has separate entries, so no sender can displace the stops of another sender.  If a table is full, the only
possible effect is that the team is stopped for longer.  If a sender has too many stops, its two oldest are merged into
one with a new id, which must be released.  If there are too many releases, the oldest is removed, and its stop may have
to be released again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import msgpack

from middleware.entangled.value import is_natural

ID_BYTES = 16
MAX_STOPS = 8
"""Maximum number of stops in one statement."""
MAX_STOPS_OF_SENDER = 16
"""Maximum number of separate stops of one sender."""
MAX_SENDERS = 64
"""Maximum number of senders with separate stops; further senders share one entry."""
MAX_RELEASED = 512
"""Maximum number of stored releases, and of stops in one release."""
MAX_OPERATOR_CHARACTERS = 64
"""Maximum characters of the operator's name."""
MAX_OPERATOR_BYTES = 48
"""Maximum bytes of an operator's name in messages, so that eight stops fit into one record, which every device
stores."""
_SHARED = b""
"""The sender for the stops of senders beyond ``MAX_SENDERS``."""


@dataclass(frozen=True)
class Statement:
    """The orders of one sender: its stops in force (id to operator), and the ids of the stops that it released.

    ``by`` is the operator of the newest order.
    """

    stops: Mapping[bytes, str]
    released: tuple[bytes, ...] = ()
    by: str = ""

    def pack(self) -> list[object]:
        """Return the arguments of ``device.halt``; packed, they are also the value of the sender's record."""
        return [[[stop, by] for stop, by in self.stops.items()], list(self.released), self.by]


class StopSet:
    """The stops of each sender (a public key), and the ids of the released stops, each with the newest last."""

    def __init__(self) -> None:
        self._stops: dict[bytes, dict[bytes, str]] = {}
        self._released: dict[bytes, None] = {}

    @property
    def in_force(self) -> dict[bytes, str]:
        """The stops that are not released (id to operator); empty if the team is not stopped."""
        return {stop: by for stops in self._stops.values() for stop, by in stops.items()}

    def get_stops(self, sender: bytes) -> dict[bytes, str]:
        """Return the stops of ``sender`` that are in force, the newest last."""
        return dict(self._stops.get(sender, {}))

    def merge(self, sender: bytes, statement: Statement, may_release: bool = True) -> bool:
        """Merge the orders of ``sender``, its releases only if ``may_release``; return whether anything is new."""
        is_new = False
        for stop in statement.released if may_release else ():
            is_new |= self._release(stop)
        for stop, by in statement.stops.items():
            if stop not in self._released:
                is_new |= self._add(sender, stop, by)
        return is_new

    def pack(self) -> list[object]:
        """Return the encoding for the store."""
        stops = [[sender, [[stop, by] for stop, by in stops.items()]] for sender, stops in self._stops.items()]
        return [stops, list(self._released)]

    def _release(self, stop: bytes) -> bool:
        if stop in self._released:
            return False
        self._released[stop] = None
        if len(self._released) > MAX_RELEASED:
            del self._released[next(iter(self._released))]
        for stops in self._stops.values():
            stops.pop(stop, None)
        self._stops = {sender: stops for sender, stops in self._stops.items() if stops}
        return True

    def _add(self, sender: bytes, stop: bytes, by: str) -> bool:
        if sender not in self._stops and len(self._stops) >= MAX_SENDERS:
            sender = _SHARED
        stops = self._stops.setdefault(sender, {})
        if stop in stops:
            return False
        stops[stop] = by
        if len(stops) > MAX_STOPS_OF_SENDER:
            (first, _), (second, by) = list(stops.items())[:2]
            rest = {each: by for each, by in stops.items() if each not in (first, second)}
            self._stops[sender] = {derive_id(first, second): by, **rest}
        return True


def derive_id(*parts: bytes) -> bytes:
    """Return the id of a stop that has no random id, derived from ``parts``."""
    return hashlib.blake2s(b"".join(parts), digest_size=ID_BYTES, person=b"stop").digest()


def clip_name(by: str) -> str:
    """Cut the name of an operator to at most ``MAX_OPERATOR_BYTES`` bytes."""
    return by.encode(errors="ignore")[:MAX_OPERATOR_BYTES].decode(errors="ignore")


def parse_statement(fields: object) -> Statement | None:
    """Decode a statement; None if it is malformed."""
    if not isinstance(fields, list) or len(fields) != 3:
        return None
    stops, released, by = fields
    found = _parse_stops(stops, MAX_STOPS)
    if found is None or not _are_ids(released) or not _is_name(by):
        return None
    return Statement(found, tuple(released), by)


def parse_record_value(owner: bytes, value: bytes | None) -> Statement | None:
    """Decode the statement in a record of ``owner``; None if ``value`` has no valid statement.  Never raises.

    Earlier versions wrote ``[number, is on, by]``.  If "is on" is true, such a value is treated as a stop, which must
    be released by its derived id; otherwise the value has no effect.
    """
    try:
        fields: Any = msgpack.unpackb(value or b"")
    except Exception:  # the decoder raises many kinds of exceptions on malicious bytes
        return None
    if (
        isinstance(fields, list)
        and len(fields) == 3
        and fields[1] is True
        and is_natural(fields[0])
        and _is_name(fields[2])
    ):
        by = clip_name(fields[2])
        return Statement({derive_id(owner, value or b""): by}, (), by)
    return parse_statement(fields)


def parse_stop_set(fields: object) -> StopSet:
    """Decode a stop set from the store; raise ``ValueError`` if it is malformed."""
    stops, released = fields if isinstance(fields, list) and len(fields) == 2 else (None, None)
    found = StopSet()
    if not isinstance(stops, list) or len(stops) > MAX_SENDERS + 1 or not _are_ids(released):
        raise ValueError("the stored set of stops is malformed")
    for entry in stops:
        sender, listed = entry if isinstance(entry, list) and len(entry) == 2 else (None, None)
        of_sender = _parse_stops(listed, MAX_STOPS_OF_SENDER)
        if not isinstance(sender, bytes) or not of_sender:
            raise ValueError("the stored stops of a sender are malformed")
        found._stops[sender] = of_sender
    found._released = dict.fromkeys(released or ())
    return found


def are_ids(values: Iterable[object]) -> bool:
    """Return whether each of ``values`` is a valid id of a stop."""
    return all(isinstance(value, bytes) and len(value) == ID_BYTES for value in values)


def _are_ids(values: object) -> bool:
    return isinstance(values, list) and len(values) <= MAX_RELEASED and are_ids(values)


def _is_name(by: object) -> bool:
    return isinstance(by, str) and len(by) <= MAX_OPERATOR_CHARACTERS


def _parse_stops(listed: object, most: int) -> dict[bytes, str] | None:
    if not isinstance(listed, list) or len(listed) > most:
        return None
    pairs: list[Any] = [pair for pair in listed if isinstance(pair, list) and len(pair) == 2 and are_ids(pair[:1])]
    if len(pairs) < len(listed) or not all(_is_name(by) for _, by in pairs):
        return None
    found: dict[bytes, str] = dict(pairs)
    return found
