"""Define the interface by which a node sends and receives datagrams.

``udp`` implements the interface with UDP, ``switchboard`` in memory; ``combined_network`` adds tunnels.  Protocol code
receives a ``Network`` and never opens a socket.
"""

from __future__ import annotations

from collections.abc import Callable
from ipaddress import IPv6Address
from typing import NamedTuple, Protocol, runtime_checkable

MAX_DATAGRAM_BYTES = 1400
MAX_RELAYED_BYTES = 1452
"""The maximum length of a relayed datagram, which contains the datagram that is relayed: 1500 bytes minus the headers
of IPv6 and UDP."""
ANY_HOST = "*"
"""The host that means every interface of both address families."""
MAX_ASSIGNED = 1024
"""The number of addresses for which a network remembers the local port to send from."""
_RELAYED_LENGTH = 41
ADDRESS_BYTES = 18
"""The bytes of an address in datagrams: an IPv6 address (16, IPv4 mapped into it) and the port (2)."""
_IPV4_PREFIX = bytes(10) + b"\xff\xff"
_NONE = bytes(ADDRESS_BYTES)


class Address(NamedTuple):
    """The host and port of a node."""

    host: str
    port: int

    @property
    def is_virtual(self) -> bool:
        """Whether this address means a path of this node (a tunnel, a relay) and is useless to other nodes."""
        return self[0][:1] == "~"

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


def relayed_address(node_id: bytes) -> Address:
    """Return the virtual address of the node with this id, which is reached through relays."""
    return Address(f"~{node_id.hex()}", 1)


def is_relayed(address: Address) -> bool:
    """Return whether an address is the result of ``relayed_address``."""
    return len(address.host) == _RELAYED_LENGTH and address.host[0] == "~"


def pack_address(address: Address) -> bytes:
    """Encode an address in 18 bytes, which are zero if its host is not an IP address."""
    host, port = address
    try:
        if ":" in host:
            packed = IPv6Address(host.partition("%")[0]).packed
        else:
            packed = _IPV4_PREFIX + bytes(map(int, host.split(".")))
        return packed + port.to_bytes(2, "little") if len(packed) == 16 else _NONE
    except (ValueError, OverflowError):
        return _NONE


def parse_address(packed: bytes) -> Address | None:
    """Decode an address from 18 bytes; None for zero, or if the length is wrong."""
    port = int.from_bytes(packed[16:], "little")
    if len(packed) != ADDRESS_BYTES or not port:
        return None
    if packed.startswith(_IPV4_PREFIX):
        return Address(".".join(map(str, packed[12:16])), port)
    return Address(str(IPv6Address(packed[:16])), port)


Receiver = Callable[[bytes, Address], None]


class Network(Protocol):
    """A datagram port of one node."""

    @property
    def address(self) -> Address:
        """The node's address; the port is known after ``listen``."""

    def listen(self, receiver: Receiver) -> None:
        """Open the port and pass each datagram to ``receiver``; raises ``PortInUse`` if the port is in use."""

    def send(self, datagram: bytes, to: Address) -> None:
        """Send at most ``MAX_RELAYED_BYTES`` bytes; a datagram that cannot be sent is lost."""

    def close(self) -> None:
        """Close the port; may be called twice."""


@runtime_checkable
class LocalPorts(Protocol):
    """A network that can use several local ports; the number 0 means the listening port.

    A datagram is sent from the port that was assigned to its target, otherwise from the port that first received a
    datagram of the target.
    """

    def open_port(self) -> int:
        """Open an additional free local port and return it; 0 if that fails."""

    def close_port(self, port: int) -> None:
        """Close an additional port; its targets are assigned to the listening port again."""

    def assign_port(self, to: Address, port: int) -> int:
        """Assign a local port to the target ``to``; return the previous one."""

    def source_address(self, to: Address, port: int = 0) -> Address:
        """Return the local source address of datagrams to ``to`` (from ``port``, if given)."""

    def local_hosts(self) -> list[str]:
        """Return the addresses of this machine at which ``listen`` receives, except the loopback address."""


def find_ports(network: object) -> LocalPorts | None:
    """Return the local ports of a network or of the network in its ``ports``; None if it has only one port."""
    return network if isinstance(network, LocalPorts) else getattr(network, "ports", None)


def find_alternate_paths(network: object) -> list[Address]:
    """Return the virtual addresses by which a network reaches known nodes without UDP (its ``alternate_paths``)."""
    return list(getattr(network, "alternate_paths", ()))
