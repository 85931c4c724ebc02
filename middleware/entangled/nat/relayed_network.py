"""Wrap a network so that nodes that are reached through relays have virtual addresses.

Datagrams to a virtual address are passed to ``send_relayed``; relayed datagrams are passed to the receiver with a
virtual source address.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from middleware.entangled.network.network import Address, Network, Receiver, find_ports, is_relayed


class RelayedNetwork:
    """``network`` with relayed paths; ``ports`` is the network itself, if it supports several ports."""

    def __init__(self, network: Network) -> None:
        self.send_relayed: Callable[[bytes, Address], None] = lambda datagram, to: None
        self._network = network
        self._ports = find_ports(network)
        self._receiver: Receiver | None = None

    @property
    def address(self) -> Address:
        """The address of the underlying network."""
        return self._network.address

    @property
    def counters(self) -> Counter[str]:
        """The counters of the underlying network; empty if the network does not count."""
        counters = getattr(self._network, "counters", None)
        return counters if isinstance(counters, Counter) else Counter()

    def listen(self, receiver: Receiver) -> None:
        """Open the port; raises ``PortInUse``."""
        self._network.listen(receiver)
        self._receiver = receiver

    def send(self, datagram: bytes, to: Address) -> None:
        """Send a datagram directly or through a relay."""
        if is_relayed(to):
            self.send_relayed(datagram, to)
        else:
            self._network.send(datagram, to)

    def close(self) -> None:
        """Close the port; may be called twice."""
        self._receiver = None
        self._network.close()

    def receive_relayed(self, datagram: bytes, source: Address) -> None:
        """Receive a relayed datagram from the node with that address."""
        if self._receiver is not None:
            self._receiver(datagram, source)

    # -- local ports ------------------------------------------------------------------------------------------------

    def open_port(self) -> int:
        """Open an additional local port and return it; 0 if the underlying network has only one."""
        return self._ports.open_port() if self._ports is not None else 0

    def close_port(self, port: int) -> None:
        """Close an additional port."""
        if self._ports is not None:
            self._ports.close_port(port)

    def assign_port(self, to: Address, port: int) -> int:
        """Assign a local port to the target ``to``; return the previous one."""
        return self._ports.assign_port(to, port) if self._ports is not None else 0

    def source_address(self, to: Address, port: int = 0) -> Address:
        """Return the local source address of datagrams to ``to``."""
        return self._ports.source_address(to, port) if self._ports is not None else self._network.address

    def local_hosts(self) -> list[str]:
        """Return the addresses of this machine at which the network listens."""
        return self._ports.local_hosts() if self._ports is not None else [self._network.address.host]
