"""Path: a network in which a node that others carry to has an address, too.

It goes around the node's own network.  What is sent to such an address is handed to ``carry``; what others carried here
is given to the receiver as if it had come from there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from middleware.entangled.network.network import Address, Network, Receiver, is_relayed, ports_of


class PathNetwork:
    """``network``, and what others carry; ``ports`` is the network itself, where it can have more than one port."""

    def __init__(self, network: Network) -> None:
        self.carry: Callable[[bytes, Address], None] = lambda datagram, to: None
        self._network = network
        self._ports = ports_of(network)
        self._receiver: Receiver | None = None

    @property
    def address(self) -> Address:
        """The address of the network underneath."""
        return self._network.address

    @property
    def counters(self) -> Counter[str]:
        """What the network underneath counts; nothing where it counts nothing."""
        counters = getattr(self._network, "counters", None)
        return counters if isinstance(counters, Counter) else Counter()

    def listen(self, receiver: Receiver) -> None:
        """Open the port; raises ``PortInUse``."""
        self._network.listen(receiver)
        self._receiver = receiver

    def send(self, datagram: bytes, to: Address) -> None:
        """Send, or have it carried."""
        if is_relayed(to):
            self.carry(datagram, to)
        else:
            self._network.send(datagram, to)

    def close(self) -> None:
        """Close the port; may be called twice."""
        self._receiver = None
        self._network.close()

    def carried(self, datagram: bytes, source: Address) -> None:
        """Take a datagram that somebody carried here for the node with that address."""
        if self._receiver is not None:
            self._receiver(datagram, source)

    # -- local ports ------------------------------------------------------------------------------------------------

    def open_port(self) -> int:
        """A further local port; 0 where the network underneath has only one."""
        return self._ports.open_port() if self._ports is not None else 0

    def shut_port(self, port: int) -> None:
        """Close a further port."""
        if self._ports is not None:
            self._ports.shut_port(port)

    def lead(self, to: Address, port: int) -> int:
        """Let what goes to ``to`` leave by a port; gives the one by which it left so far."""
        return self._ports.lead(to, port) if self._ports is not None else 0

    def local(self, to: Address, port: int = 0) -> Address:
        """The address of this machine from which a datagram to ``to`` leaves."""
        return self._ports.local(to, port) if self._ports is not None else self._network.address

    def hosts(self) -> list[str]:
        """The addresses of this machine at which it hears."""
        return self._ports.hosts() if self._ports is not None else [self._network.address.host]
