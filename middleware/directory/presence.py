"""Presence: who is here, what it can do, and how it is.

Each device announces itself in an owner-leased record under one key, so it disappears with its node.  The order of
joining is a number, one more than the highest seen when the device came, so it needs no common clock and is the same
on every node.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import msgpack

from middleware.entangled.identity import node_id
from middleware.entangled.record import Record, hashed_key
from middleware.entangled.value import MAX_VALUE, are_capabilities, is_number, is_whole, mapping_of

DEVICES = hashed_key("devices")
IDLE, ASSIGNED, SEARCHING, WAITING, EXECUTING, DONE = "IDLE", "ASSIGNED", "SEARCHING", "WAITING", "EXECUTING", "DONE"
STATUSES = (IDLE, ASSIGNED, SEARCHING, WAITING, EXECUTING, DONE)
MAX_DEPTH = 16
"""The directory is split no further: 2**16 places are enough for a million devices."""
ID_SHOWN = 6
MESSAGES_KEPT = 5
MESSAGE_CHARACTERS = 70
STOPS_SHOWN = 4
"""Stops that a device says it obeys; each takes 34 bytes of its record."""

Capabilities = Mapping[str, Mapping[str, float | str]]


@dataclass(frozen=True)
class Device:
    """What a device says of itself (thesis, Algorithm 4.3).

    ``uuid`` is its node id in hex; ``joined`` its place in the order of joining; ``since`` seconds of the wall clock,
    for people; ``messages`` are its newest (time, text) lines; ``deployed`` maps each module that was pushed to the
    version and digest that it runs, or says that it was refused; ``pages`` are the URLs at which it serves the page;
    ``position`` is where it says that it is: ``x`` and ``y`` in metres and ``heading`` in radians in the yard's frame,
    or ``lat`` and ``lon`` in degrees with ``accuracy`` in metres; ``laptop`` and ``agent`` are what people call the
    computer that its node runs on and the agent that acts for it (thesis, Table 5.1); ``depth`` is how far the
    directory is split where it stands (``middleware.directory.prefix``); ``stops`` are the ids in hex of the stops that
    it obeys, ``STOPS_SHOWN`` at most, and ``obeys`` is what it does while the team is stopped
    (``middleware.stop.halt``).
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
    deployed: Mapping[str, str] = field(default_factory=dict)
    pages: tuple[str, ...] = ()
    position: Mapping[str, float] = field(default_factory=dict)
    laptop: str = ""
    agent: str = ""
    depth: int = 0
    stops: tuple[str, ...] = ()
    obeys: str = ""

    def with_message(self, now: float, text: str) -> Device:
        """This device with one more line; the oldest goes when there are more than ``MESSAGES_KEPT``."""
        line = (now, text[:MESSAGE_CHARACTERS])
        return replace(self, messages=(*self.messages, line)[-MESSAGES_KEPT:])

    def packed(self) -> bytes:
        """The value of its record; where it is too large, messages give way, then description, then ``deployed``."""
        device = self
        while True:
            content = dict(vars(device))
            # Most devices have none of them, and each byte of a record is sent again and again.
            for name in ("pages", "position", "laptop", "agent", "depth", "stops", "obeys"):
                if not content[name]:
                    del content[name]
            value = bytes(msgpack.packb(content))
            if len(value) <= MAX_VALUE or not (device.messages or device.description or device.deployed):
                return value
            if device.messages:
                device = replace(device, messages=device.messages[1:])
            elif device.description:
                device = replace(device, description="")
            else:
                device = replace(device, deployed={})


def device_of(record: Record) -> Device | None:
    """The device that a record announces, or None where its value is not one, or one of another node.

    It is announced under the name of the record's slot, which replicas compare with the certificate of its owner.
    """
    value = mapping_of(record)
    if value is None or value.get("uuid") != node_id(record.owner).hex() or value.get("name") != record.name:
        return None
    content = {f.name: value[f.name] for f in fields(Device) if f.name in value}
    try:
        content["messages"] = tuple((float(t), text) for t, text in content.get("messages", ()))
        content["roles"] = tuple(content.get("roles", Device.roles))
        pages = content.get("pages", [])
        content["pages"] = tuple(pages) if isinstance(pages, list) else (None,)
        stops = content.get("stops", [])
        content["stops"] = tuple(stops) if isinstance(stops, list) else (None,)
        device = Device(**content)
    except (TypeError, ValueError, OverflowError):
        return None
    texts = (device.name, device.kind, device.description, device.address, device.task, device.status, *device.roles)
    texts += (device.laptop, device.agent, device.obeys)
    lawful = (
        all(
            isinstance(text, str)
            for text in (*texts, *device.pages, *device.stops, *(text for _, text in device.messages))
        )
        and device.status in STATUSES
        and is_whole(device.joined)
        and is_whole(device.depth)
        and device.depth <= MAX_DEPTH
        and len(device.stops) <= STOPS_SHOWN
        and all(is_number(n) for n in (device.since, *(t for t, _ in device.messages)))
        and are_capabilities(device.capabilities)
        and isinstance(device.network, dict)
        and isinstance(device.deployed, dict)
        and all(isinstance(name, str) and isinstance(label, str) for name, label in device.deployed.items())
        and all(isinstance(name, str) and is_number(n) for name, n in device.network.items())
        and isinstance(device.position, dict)
        and all(isinstance(name, str) and is_number(n) for name, n in device.position.items())
    )
    return device if lawful else None


def devices_of(records: list[Record]) -> list[tuple[Device, Record]]:
    """The devices in ``records`` in the order of joining, each with its record.

    Where several have the same name each is told apart by the beginning of its id.
    """
    known = [(device, record) for record in records if (device := device_of(record)) is not None]
    counts = Counter(name for name, _ in {(device.name, device.uuid) for device, _ in known})
    known = [
        (replace(device, name=f"{device.name}-{device.uuid[:ID_SHOWN]}") if counts[device.name] > 1 else device, record)
        for device, record in known
    ]
    return sorted(known, key=lambda pair: (pair[0].joined, pair[0].uuid))


Announce = Callable[[bytes], None]
Later = Callable[[float, Callable[[], None]], object]


class Presence:
    """This node's own device record, announced when it changes and at most every ``PAUSE`` seconds."""

    PAUSE = 0.1

    def __init__(self, device: Device, announce: Announce, later: Later) -> None:
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

    def obey(self, stops: Collection[bytes], words: str) -> None:
        """Say which stops the device obeys, and what it does; no stops: it goes on."""
        self.change(stops=tuple(stop.hex() for stop in list(stops)[-STOPS_SHOWN:]), obeys=words)

    def _tell(self) -> None:
        self._pending = False
        self._announce(self.device.packed())
