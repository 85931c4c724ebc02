"""Define the multicast group of the LAN, through which a node finds nodes with unknown addresses.

``lan`` implements it with sockets, ``SimulatedLan`` in memory.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from middleware.entangled.network.network import Address, Receiver
from middleware.entangled.network.switchboard import Switchboard, SwitchboardNetwork

GROUP = Address("239.192.83.87", 8483)
"""An address of the organisation-local scope (RFC 2365, section 6.2); no datagram leaves the LAN."""
GROUP6 = Address("ff02::8357", 8483)


class Multicast(Protocol):
    """One node's membership of the group; all nodes on the LAN receive its datagrams and reply to their source."""

    def listen(self, receiver: Receiver, on_moved: Callable[[], None]) -> None:
        """Pass each datagram from the group, and each reply, to ``receiver``; never raises.

        ``on_moved`` is called, until ``close``, when the node has moved to another LAN and should search for nodes
        again.
        """

    def send(self, datagram: bytes) -> None:
        """Send to the group on every interface; a datagram that cannot be sent is lost."""

    def close(self) -> None:
        """Leave the group; may be called twice."""


class SimulatedLan:
    """A simulated LAN: all its members are in one group, over the ports of a ``Switchboard``.

    ``is_blocked``: multicast does not pass, as at many access points.
    """

    def __init__(self, switchboard: Switchboard) -> None:
        self.is_blocked = False
        self.groups: list[SimulatedMulticast] = []
        self._switchboard = switchboard

    def join(self, host: str = "10.0.0.1") -> SimulatedMulticast:
        """Create a membership of the group for the node at ``host``."""
        return SimulatedMulticast(self, self._switchboard.make_network(host), self._switchboard.make_network(host))


class SimulatedMulticast:
    """One node's membership in the group of a ``SimulatedLan``; a ``Multicast``.

    As with sockets, the membership has one port to receive from the group and a second port to send; ``addresses``
    contains both.  A test calls ``moved`` when it moves the node to another LAN.
    """

    def __init__(
        self, lan: SimulatedLan, receiving_network: SwitchboardNetwork, sending_network: SwitchboardNetwork
    ) -> None:
        self.on_moved: Callable[[], None] = lambda: None
        self._lan = lan
        self._receiving_network = receiving_network
        self._sending_network = sending_network

    @property
    def addresses(self) -> tuple[Address, Address]:
        """The address that receives from the group, and the address that sends datagrams and receives replies."""
        return self._receiving_network.address, self._sending_network.address

    def listen(self, receiver: Receiver, on_moved: Callable[[], None]) -> None:
        """Pass each datagram from the group, and each reply, to ``receiver``."""
        self.on_moved = on_moved
        self._receiving_network.listen(receiver)
        self._sending_network.listen(receiver)
        self._lan.groups.append(self)

    def send(self, datagram: bytes) -> None:
        """Send to every member of the group, including this node."""
        if not self._lan.is_blocked:
            for other in self._lan.groups:
                self._sending_network.send(datagram, other.addresses[0])

    def close(self) -> None:
        """Leave the group; may be called twice."""
        if self in self._lan.groups:
            self._lan.groups.remove(self)
        self._receiving_network.close()
        self._sending_network.close()
