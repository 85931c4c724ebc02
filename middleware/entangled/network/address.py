"""Address in bytes, as it stands in datagrams: an IPv6 address (16, IPv4 mapped into it) and the port (2)."""

from __future__ import annotations

from ipaddress import IPv6Address

from middleware.entangled.network.network import Address

ADDRESS = 18
_MAPPED = bytes(10) + b"\xff\xff"
_NONE = bytes(ADDRESS)


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
