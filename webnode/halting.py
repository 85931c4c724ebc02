"""Halting: the button that stops the whole team."""

from __future__ import annotations

from collections.abc import Callable

from twisted.internet.defer import Deferred

from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.record import Record
from middleware.node import SwarmNode
from middleware.presence import DEVICES, devices_of
from webnode.board import Halts
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
        return self._node.halt.order(True, by, self._contacts())

    def release(self, by: str) -> Deferred[dict[str, str]]:
        """Let it go on."""
        return self._node.halt.order(False, by, self._contacts())

    def is_halted(self) -> bool:
        """Whether the team is halted."""
        return self._node.halt.word.is_on

    def _contacts(self) -> list[Contact]:
        records = [record for _, record in devices_of(self._devices())]
        return [contact for record in records if (contact := self._node.contact_of(record)) is not None]
