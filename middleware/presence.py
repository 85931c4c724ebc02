"""Presence: who is here, what it can do, and how it is.

Each device announces itself in an owner-leased record under one key, so it disappears with its node.  The order of joining is
a number, one more than the highest seen when the device came, so it needs no common clock and is the same on every node.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import msgpack

from middleware.entangled.record import MAX_VALUE, Record, hashed_key

DEVICES = hashed_key("devices")
IDLE, ASSIGNED, SEARCHING, WAITING, EXECUTING, DONE = "IDLE", "ASSIGNED", "SEARCHING", "WAITING", "EXECUTING", "DONE"
STATUSES = (IDLE, ASSIGNED, SEARCHING, WAITING, EXECUTING, DONE)
MESSAGES_KEPT = 5
MESSAGE_CHARACTERS = 70

Capabilities = Mapping[str, Mapping[str, float | str]]


@dataclass(frozen=True)
class Device:
    """What a device says of itself (thesis, Algorithm 4.3).

    ``uuid`` is its node id in hex; ``joined`` its place in the order of joining; ``since`` seconds of the wall clock, for
    people; ``messages`` are its newest (time, text) lines.
    """

    uuid: str
    name: str
    kind: str = "generic"
    description: str = ""
    capabilities: Capabilities = field(default_factory=dict)
    address: str = ""
    roles: tuple[str, ...] = ("edge",)
    joined: int = 0
    since: float = 0.0
    task: str = ""
    status: str = IDLE
    messages: tuple[tuple[float, str], ...] = ()
    network: Mapping[str, int] = field(default_factory=dict)

    def with_message(self, now: float, text: str) -> Device:
        """This device with one more line; the oldest goes when there are more than ``MESSAGES_KEPT``."""
        line = (now, text[:MESSAGE_CHARACTERS])
        return replace(self, messages=(*self.messages, line)[-MESSAGES_KEPT:])

    def packed(self) -> bytes:
        """The value of the device's record; the oldest messages and the description give way where it would be too large."""
        device = self
        while True:
            value = bytes(msgpack.packb(asdict(device)))
            if len(value) <= MAX_VALUE or not (device.messages or device.description):
                return value
            device = replace(device, messages=device.messages[1:]) if device.messages else replace(device, description="")


def device_of(record: Record) -> Device | None:
    """The device that a record announces, or None where its value is not one."""
    value = _mapping(record.value)
    if value is None or not isinstance(value.get("uuid"), str) or not isinstance(value.get("name"), str):
        return None
    known = {f.name: type(f.default) for f in fields(Device) if f.name in value}
    try:
        value["messages"] = tuple((float(t), str(text)) for t, text in value.get("messages", ()))
        value["roles"] = tuple(str(role) for role in value.get("roles", ()))
        device = Device(**{name: value[name] for name in known})
        lawful = device.status in STATUSES and type(device.joined) is int and isinstance(device.capabilities, dict)
        return device if lawful and math.isfinite(float(device.since)) else None
    except (TypeError, ValueError):
        return None


def devices_of(records: list[Record]) -> list[tuple[Device, Record]]:
    """The devices in ``records`` in the order of joining, each with its record."""
    known = [(device, record) for record in records if (device := device_of(record)) is not None]
    return sorted(known, key=lambda pair: (pair[0].joined, pair[0].uuid))


def _mapping(value: bytes | None) -> dict[str, Any] | None:
    if value is None:
        return None
    try:
        content = msgpack.unpackb(value, strict_map_key=True)
    except Exception:  # the decoder raises many kinds on crafted bytes
        return None
    return content if isinstance(content, dict) else None


Announce = Callable[[bytes], None]


class Presence:
    """This node's own device record, announced when it changes and at most every ``PAUSE`` seconds."""

    PAUSE = 0.1

    def __init__(self, device: Device, announce: Announce, later: Callable[[float, Callable[[], None]], object]) -> None:
        self.device = device
        self._announce = announce
        self._later = later
        self._pending = False
        self._present = False

    def appear(self, joined: int) -> None:
        """Announce the device for the first time, with its place in the order of joining."""
        self.device = replace(self.device, joined=joined)
        self._present = True
        self._announce(self.device.packed())

    def change(self, **changes: Any) -> None:
        """Announce what is new; unchanged fields cost nothing."""
        device = replace(self.device, **changes)
        if device == self.device:
            return
        self.device = device
        if self._present and not self._pending:
            self._pending = True
            self._later(self.PAUSE, self._tell)

    def say(self, now: float, text: str) -> None:
        """Add a line to the device's messages."""
        self.change(messages=self.device.with_message(now, text).messages)

    def _tell(self) -> None:
        self._pending = False
        self._announce(self.device.packed())
