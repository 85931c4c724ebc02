"""Network: the one place where datagrams leave and enter a node.

``udp`` has the real one, ``switchboard`` the one in memory.  Logic receives a ``Network`` and never opens a socket.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

MAX_DATAGRAM = 1400


class Address(NamedTuple):
    """Where a node is reached."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


Receiver = Callable[[bytes, Address], None]


class Network(Protocol):
    """A datagram port of one node."""

    @property
    def address(self) -> Address:
        """The node's own address; the port is known once ``listen`` was called."""

    def listen(self, receiver: Receiver) -> None:
        """Open the port and hand each datagram to ``receiver``; raises ``PortInUse`` where another holds it."""

    def send(self, datagram: bytes, to: Address) -> None:
        """Send at most ``MAX_DATAGRAM`` bytes; what cannot be sent is lost, as datagrams may be."""

    def close(self) -> None:
        """Close the port; may be called twice."""
