"""Network: the one place where datagrams leave and enter a node.

``udp`` has the real one, ``switchboard`` the one in memory; ``joint`` has tunnels beside it.  Logic receives a
``Network`` and never opens a socket.
"""

from __future__ import annotations

from collections.abc import Callable
from ipaddress import IPv6Address
from typing import NamedTuple, Protocol, runtime_checkable

MAX_DATAGRAM = 1400
MAX_CARRIED = 1452
"""A datagram that carries another one for somebody else: what 1500 bytes hold besides the headers of IPv6 and UDP."""
EVERYWHERE = "*"
"""The host that stands for every interface of both families."""
MAX_LED = 1024
"""Addresses of which a network keeps in mind by which local port they are written to."""
_RELAYED = 41
ADDRESS = 18
"""Bytes of an address in datagrams: an IPv6 address (16, IPv4 mapped into it) and the port (2)."""
_MAPPED = bytes(10) + b"\xff\xff"
_NONE = bytes(ADDRESS)


class Address(NamedTuple):
    """Where a node is reached."""

    host: str
    port: int

    @property
    def is_virtual(self) -> bool:
        """Whether it stands for a way that only this node has (a tunnel, a relay), and leads nobody else anywhere."""
        return self[0][:1] == "~"

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


def relayed(node_id: bytes) -> Address:
    """The address that stands for the node of this id where others carry what is sent to it."""
    return Address(f"~{node_id.hex()}", 1)


def is_relayed(address: Address) -> bool:
    """Whether an address is one that ``relayed`` gives."""
    return len(address.host) == _RELAYED and address.host[0] == "~"


def packed_address(address: Address) -> bytes:
    """The 18 bytes; zero for what is no address of the internet, such as a name."""
    host, port = address
    try:
        if ":" in host:
            packed = IPv6Address(host.partition("%")[0]).packed
        else:
            packed = _MAPPED + bytes(map(int, host.split(".")))
        return packed + port.to_bytes(2, "little") if len(packed) == 16 else _NONE
    except (ValueError, OverflowError):
        return _NONE


def address_of(packed: bytes) -> Address | None:
    """The address in 18 bytes; None where none was packed, or they are too few."""
    port = int.from_bytes(packed[16:], "little")
    if len(packed) != ADDRESS or not port:
        return None
    if packed.startswith(_MAPPED):
        return Address(".".join(map(str, packed[12:16])), port)
    return Address(str(IPv6Address(packed[:16])), port)


Receiver = Callable[[bytes, Address], None]


class Network(Protocol):
    """A datagram port of one node."""

    @property
    def address(self) -> Address:
        """The node's own address; the port is known once ``listen`` was called."""

    def listen(self, receiver: Receiver) -> None:
        """Open the port and hand each datagram to ``receiver``; raises ``PortInUse`` where another holds it."""

    def send(self, datagram: bytes, to: Address) -> None:
        """Send at most ``MAX_CARRIED`` bytes; what cannot be sent is lost, as datagrams may be."""

    def close(self) -> None:
        """Close the port; may be called twice."""


@runtime_checkable
class Ports(Protocol):
    """What a network can do besides, that may use several local ports: 0 stands for the one that it listens at.

    A datagram goes out by the port to which its target was led, else by the one where something from there came in
    first.
    """

    def open_port(self) -> int:
        """A further local port, any free one; 0 where there is none to be had."""

    def shut_port(self, port: int) -> None:
        """Close a further port; what was led there goes by the first one again."""

    def lead(self, to: Address, port: int) -> int:
        """Let what goes to ``to`` leave by a port from now on; gives the one by which it left so far."""

    def local(self, to: Address, port: int = 0) -> Address:
        """The address of this machine from which a datagram to ``to`` leaves (by ``port``, where given)."""

    def hosts(self) -> list[str]:
        """The addresses of this machine at which ``listen`` hears, its loopback not among them."""


def ports_of(network: object) -> Ports | None:
    """The local ports of a network, or of the one that it goes around (its ``ports``); None where it has only one."""
    return network if isinstance(network, Ports) else getattr(network, "ports", None)


def detours_of(network: object) -> list[Address]:
    """The virtual addresses by which a network leads to known nodes where no datagram passes (its ``detours``)."""
    return list(getattr(network, "detours", ()))
