"""Presence: the record in which each device announces its capabilities and status.

The node renews the lease of the record, so the record disappears when the node does.  When a device joins, it takes a
number one higher than the highest number that it finds.  These numbers define the order of joining, which is the same
at every node and needs no common clock.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import msgpack

from middleware.entangled.identity import derive_node_id
from middleware.entangled.record import Record, hash_key
from middleware.entangled.value import MAX_VALUE_BYTES, are_capabilities, is_natural, is_number, parse_mapping

DEVICES = hash_key("devices")
IDLE, ASSIGNED, SEARCHING, WAITING, EXECUTING, DONE = "IDLE", "ASSIGNED", "SEARCHING", "WAITING", "EXECUTING", "DONE"
STATUSES = (IDLE, ASSIGNED, SEARCHING, WAITING, EXECUTING, DONE)
MAX_DEPTH = 16
"""Maximum depth of the directory: 2**16 parts are enough for a million devices."""
SHOWN_ID_CHARACTERS = 6
MAX_MESSAGES = 5
MAX_MESSAGE_CHARACTERS = 70
MAX_STOPS = 4
"""Maximum number of stops in a device's record; each takes 34 bytes."""

Capabilities = Mapping[str, Mapping[str, float | str]]


@dataclass(frozen=True)
class Device:
    """The presence record of a device (thesis, Algorithm 4.3).

    - ``uuid``: the node id in hex
    - ``joined``: the device's number in the order of joining, from 1
    - ``since``: wall-clock seconds, for display
    - ``messages``: the newest (time, text) lines
    - ``deployed``: for each deployed module the running version with its digest, or the reason why the module was
      rejected
    - ``pages``: the URLs at which the device's node serves the page
    - ``position``: ``x`` and ``y`` in metres and ``heading`` in radians on the simulator's map, or ``lat`` and ``lon``
      in degrees with ``accuracy`` in metres
    - ``laptop``, ``agent``: display names of the computer and of the agent (thesis, Table 5.1)
    - ``depth``: the depth at which the device is listed in the directory (``middleware.directory.prefix``)
    - ``stops``: the ids, in hex, of the emergency stops in force that the device has received, at most ``MAX_STOPS``
    - ``obeys``: the activity of the device while the team is stopped, such as
      ``middleware.stop.stop_state.STANDS_STILL``
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
        """Return this device with one more message; only the newest ``MAX_MESSAGES`` are kept."""
        line = (now, text[:MAX_MESSAGE_CHARACTERS])
        return replace(self, messages=(*self.messages, line)[-MAX_MESSAGES:])

    def pack(self) -> bytes:
        """Return the value of the device's record.

        If the value is too large, the messages, the description and ``deployed`` are removed, in that order.
        """
        device = self
        while True:
            content = dict(vars(device))
            # omit empty fields: most devices have none of these, and the record is sent often
            for name in ("pages", "position", "laptop", "agent", "depth", "stops", "obeys"):
                if not content[name]:
                    del content[name]
            value = bytes(msgpack.packb(content))
            if len(value) <= MAX_VALUE_BYTES or not (device.messages or device.description or device.deployed):
                return value
            if device.messages:
                device = replace(device, messages=device.messages[1:])
            elif device.description:
                device = replace(device, description="")
            else:
                device = replace(device, deployed={})


def parse_device(record: Record) -> Device | None:
    """Decode the device in a record; None if the record is invalid or describes a device of another node.

    The device's name must be the name of the record's slot, which replicas compare with the owner's certificate.
    """
    value = parse_mapping(record)
    if value is None or value.get("uuid") != derive_node_id(record.owner).hex() or value.get("name") != record.name:
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
    is_valid = (
        all(
            isinstance(text, str)
            for text in (*texts, *device.pages, *device.stops, *(text for _, text in device.messages))
        )
        and device.status in STATUSES
        and is_natural(device.joined)
        and is_natural(device.depth)
        and device.depth <= MAX_DEPTH
        and len(device.stops) <= MAX_STOPS
        and all(is_number(n) for n in (device.since, *(t for t, _ in device.messages)))
        and are_capabilities(device.capabilities)
        and isinstance(device.network, dict)
        and isinstance(device.deployed, dict)
        and all(isinstance(name, str) and isinstance(label, str) for name, label in device.deployed.items())
        and all(isinstance(name, str) and is_number(n) for name, n in device.network.items())
        and isinstance(device.position, dict)
        and all(isinstance(name, str) and is_number(n) for name, n in device.position.items())
    )
    return device if is_valid else None


def parse_devices(records: list[Record]) -> list[tuple[Device, Record]]:
    """Decode the devices in ``records``, each with its record, in the order of joining.

    If several devices have the same name, the first characters of its id are appended to the name of each.
    """
    known = [(device, record) for record in records if (device := parse_device(record)) is not None]
    counts = Counter(name for name, _ in {(device.name, device.uuid) for device, _ in known})
    known = [
        (
            replace(device, name=f"{device.name}-{device.uuid[:SHOWN_ID_CHARACTERS]}")
            if counts[device.name] > 1
            else device,
            record,
        )
        for device, record in known
    ]
    return sorted(known, key=lambda pair: (pair[0].joined, pair[0].uuid))


Announce = Callable[[bytes], None]
Later = Callable[[float, Callable[[], None]], object]


class Presence:
    """The record of this node's own device, which is announced after changes, at most every ``PAUSE_S`` seconds."""

    PAUSE_S = 0.1

    def __init__(self, device: Device, announce: Announce, later: Later) -> None:
        self.device = device
        self._announce = announce
        self._later = later
        self._is_pending = False
        self._has_appeared = False

    def appear(self, joined: int) -> None:
        """Announce the device for the first time, with its number in the order of joining."""
        self.device = replace(self.device, joined=joined)
        self._has_appeared = True
        self._announce(self.device.pack())

    def change(self, **changes: Any) -> None:
        """Announce the changed fields; if none has changed, nothing is sent."""
        device = replace(self.device, **changes)
        if device == self.device:
            return
        self.device = device
        if self._has_appeared and not self._is_pending:
            self._is_pending = True
            self._later(self.PAUSE_S, self._publish)

    def add_message(self, now: float, text: str) -> None:
        """Add a line to the device's messages."""
        self.change(messages=self.device.with_message(now, text).messages)

    def announce_stops(self, stops: Collection[bytes], words: str) -> None:
        """Announce the stops in force that the device has received, and its activity (``words``)."""
        self.change(stops=tuple(stop.hex() for stop in list(stops)[-MAX_STOPS:]), obeys=words)

    def _publish(self) -> None:
        self._is_pending = False
        self._announce(self.device.pack())
