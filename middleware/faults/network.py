"""Faults of one node's datagrams: loss, delay, duplication, and the loss of all datagrams in one direction or both.

``FaultyNetwork`` wraps any other ``Network``.  It causes the same faults at a real node as the switchboard causes
between simulated nodes.  Initially there are no faults.
"""

from __future__ import annotations

import random

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.network.network import (
    Address,
    LocalPorts,
    Network,
    Receiver,
    find_alternate_paths,
    find_ports,
)
from middleware.entangled.network.switchboard import PERFECT


class FaultyNetwork:
    """``network`` with faults.

    ``conditions`` applies to each sent and each received datagram, so a request and its reply are both affected.
    ``is_receive_blocked``: nothing is received; ``is_send_blocked``: nothing is sent.
    """

    def __init__(self, network: Network, clock: IReactorTime, rng: random.Random) -> None:
        self.conditions = PERFECT
        self.is_receive_blocked = False
        self.is_send_blocked = False
        self._network = network
        self._clock = clock
        self._rng = rng
        self._receiver: Receiver | None = None

    @property
    def address(self) -> Address:
        """The node's own address."""
        return self._network.address

    @property
    def ports(self) -> LocalPorts | None:
        """The local ports of the network."""
        return find_ports(self._network)

    @property
    def alternate_paths(self) -> list[Address]:
        """The alternate paths of the network."""
        return find_alternate_paths(self._network)

    def listen(self, receiver: Receiver) -> None:
        """Open the port, and call ``receiver`` with each datagram that no fault drops; raise ``PortInUse``."""
        self._network.listen(self._on_datagram)
        self._receiver = receiver

    def send(self, datagram: bytes, to: Address) -> None:
        """Send a datagram, unless a fault drops it."""
        if not self.is_send_blocked:
            self._forward(self._deliver_sent, datagram, to)

    def close(self) -> None:
        """Close the port; datagrams in transit are lost.  May be called twice."""
        self._receiver = None
        self._network.close()

    def _on_datagram(self, datagram: bytes, source: Address) -> None:
        if not self.is_receive_blocked:
            self._forward(self._deliver_received, datagram, source)

    def _forward(self, deliver: Receiver, datagram: bytes, address: Address) -> None:
        """Forward a datagram according to ``conditions``: immediately, delayed, twice or not at all."""
        for delay in (0.0,) if self.conditions is PERFECT else self.conditions.draw_delays(self._rng):
            if delay > 0.0:
                self._clock.callLater(delay, deliver, datagram, address)
            else:
                deliver(datagram, address)

    def _deliver_sent(self, datagram: bytes, to: Address) -> None:
        if self._receiver is not None and not self.is_send_blocked:
            self._network.send(datagram, to)

    def _deliver_received(self, datagram: bytes, source: Address) -> None:
        if self._receiver is not None and not self.is_receive_blocked:
            self._receiver(datagram, source)
