"""Multicast: a group of the LAN, through which a node finds those whose addresses it does not know.

``lan`` has the real one, ``Segment`` makes those in memory.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from middleware.entangled.network.network import Address, Receiver
from middleware.entangled.network.switchboard import Switchboard, SwitchboardNetwork

GROUP = Address("239.192.83.87", 8483)
"""Of the scope that an organisation may use as it likes (RFC 2365, section 6.2); no datagram leaves the LAN."""
GROUP6 = Address("ff02::8357", 8483)


class Multicast(Protocol):
    """One node's place in the group: what it sends all others on the LAN hear, and answer to where it came from."""

    def listen(self, receiver: Receiver, moved: Callable[[], None]) -> None:
        """Hand each datagram that comes by the group, or as an answer, to ``receiver``; never raises.

        ``moved`` is called, until ``close``, when the node has come to another LAN, so that a call there is worth it.
        """

    def send(self, datagram: bytes) -> None:
        """Send to the group on every interface; what cannot be sent is lost, as datagrams may be."""

    def close(self) -> None:
        """Leave the group; may be called twice."""


class Segment:
    """The LAN of one process: all that are made here are in one group, over the ports of a ``Switchboard``.

    ``is_blocked``: multicast does not pass, as at many access points.
    """

    def __init__(self, board: Switchboard) -> None:
        self.is_blocked = False
        self.groups: list[SegmentMulticast] = []
        self._board = board

    def group(self, host: str = "10.0.0.1") -> SegmentMulticast:
        """A new place in the group, for the node at ``host``."""
        return SegmentMulticast(self, self._board.network(host), self._board.network(host))


class SegmentMulticast:
    """One node's place on a ``Segment``; a ``Multicast``.

    As with real sockets it hears at one port and speaks from another; ``addresses`` are both.  Whoever moves the node
    to another LAN calls ``moved``.
    """

    def __init__(self, segment: Segment, ear: SwitchboardNetwork, mouth: SwitchboardNetwork) -> None:
        self.moved: Callable[[], None] = lambda: None
        self._segment = segment
        self._ear = ear
        self._mouth = mouth

    @property
    def addresses(self) -> tuple[Address, Address]:
        """Where it hears the group, and where it speaks and is answered."""
        return self._ear.address, self._mouth.address

    def listen(self, receiver: Receiver, moved: Callable[[], None]) -> None:
        """Hand each datagram that comes by the group, or as an answer, to ``receiver``."""
        self.moved = moved
        self._ear.listen(receiver)
        self._mouth.listen(receiver)
        self._segment.groups.append(self)

    def send(self, datagram: bytes) -> None:
        """Send to everybody in the group, this node included."""
        if not self._segment.is_blocked:
            for other in self._segment.groups:
                self._mouth.send(datagram, other.addresses[0])

    def close(self) -> None:
        """Leave the group; may be called twice."""
        if self in self._segment.groups:
            self._segment.groups.remove(self)
        self._ear.close()
        self._mouth.close()
