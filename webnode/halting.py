"""Halting: the button that stops the whole team."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from twisted.internet.defer import Deferred

from middleware.directory.presence import DEVICES, devices_of
from middleware.entangled.contact import Contact
from middleware.entangled.record import Record
from middleware.node import SwarmNode
from middleware.stop.stop_set import ID_BYTES
from webnode.board import Halts
from webnode.errors import Refusal
from webnode.ground import Ground


def halts(ground: Ground) -> Halts | None:
    """The button of this node."""
    return TeamHalts(ground.node, lambda: ground.desk.read(DEVICES))


class TeamHalts:
    """The button over ``node``; ``devices`` are the records of those that are here, which are told at once."""

    def __init__(self, node: SwarmNode, devices: Callable[[], list[Record]]) -> None:
        self._node = node
        self._devices = devices

    def halt(self, by: str) -> Deferred[dict[str, str]]:
        """Let everything stand, and stay."""
        return self._node.halt.stop(by, self._contacts())

    def release(self, by: str, stops: Sequence[str] | None = None) -> Deferred[dict[str, str]]:
        """End these stops, or all that this node knows and all that a device says it obeys; raises ``Refusal``."""
        named = self._known() if stops is None else [_id(stop) for stop in stops]
        return self._node.halt.release(named, by, self._contacts())

    def _known(self) -> list[bytes]:
        said = [stop for device, _ in devices_of(self._devices()) for stop in device.stops]
        return [*self._node.halt.stops, *(_id(stop) for stop in said if is_id(stop))]

    def _contacts(self) -> list[Contact]:
        records = [record for _, record in devices_of(self._devices())]
        return [contact for record in records if (contact := self._node.contact_of(record)) is not None]


def is_id(stop: str) -> bool:
    """Whether ``stop`` is the id of a stop in hex."""
    return re.fullmatch(f"[0-9a-f]{{{2 * ID_BYTES}}}", stop) is not None


def _id(stop: object) -> bytes:
    if not isinstance(stop, str) or not is_id(stop):
        raise Refusal("stops", "this is no id of a stop", "name those of /api/v1/state, or leave it out")
    return bytes.fromhex(stop)
