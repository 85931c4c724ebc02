"""Combine UDP and tunnels into one ``Network`` that selects between them by the address."""

from __future__ import annotations

from collections import Counter
from typing import Any

from middleware.entangled.errors import EntangledError
from middleware.entangled.network.network import Address, LocalPorts, Network, Receiver, find_ports
from middleware.entangled.network.tunnel import TunnelNetwork
from middleware.entangled.network.url import VIRTUAL_PREFIX


class JointNetwork:
    """``udp`` and ``tunnel`` as one network; its address is the UDP address."""

    def __init__(self, udp: Network, tunnel: TunnelNetwork) -> None:
        self.udp = udp
        self.tunnel = tunnel

    @property
    def address(self) -> Address:
        """The node's address."""
        return self.udp.address

    @property
    def counters(self) -> Counter[str]:
        """The sums of the counters of UDP and tunnels, and the counters of the tunnels prefixed by ``tunnel``."""
        counted: Counter[str] = Counter(getattr(self.udp, "counters", {}))
        counted.update({f"tunnel {name}": number for name, number in self.tunnel.counters.items()})
        for name in ("sent", "received", "unsent"):
            counted[name] += self.tunnel.counters[name]
        return counted

    @property
    def ports(self) -> LocalPorts | None:
        """The local ports of ``udp``, if it supports several."""
        return find_ports(self.udp)

    @property
    def alternate_paths(self) -> list[Address]:
        """The virtual addresses of the tunnels that may be dialled."""
        return self.tunnel.alternate_paths

    @property
    def closed(self) -> Any:
        """Fires when the UDP port is closed."""
        return getattr(self.udp, "closed", None)

    def listen(self, receiver: Receiver) -> None:
        """Open both networks; raises ``PortInUse`` if either port is in use."""
        self.udp.listen(receiver)
        try:
            self.tunnel.listen(receiver)
        except EntangledError:
            self.close()
            raise

    def send(self, datagram: bytes, to: Address) -> None:
        """Send a datagram over the network to which the address belongs."""
        if to.host.startswith(VIRTUAL_PREFIX):
            self.tunnel.send(datagram, to)
        else:
            self.udp.send(datagram, to)

    def close(self) -> None:
        """Close both networks; may be called twice."""
        self.tunnel.close()
        self.udp.close()
