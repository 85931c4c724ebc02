"""List the network interfaces of this machine (Linux)."""

from __future__ import annotations

import fcntl
import socket
import struct
from dataclasses import dataclass
from ipaddress import IPv6Address, ip_address
from pathlib import Path

_FLAGS, _ADDRESS = 0x8913, 0x8915  # SIOCGIFFLAGS, SIOCGIFADDR
_UP, _LOOPBACK, _RUNNING, _MULTICAST = 0x1, 0x8, 0x40, 0x1000
_ADDRESSES6 = Path("/proc/net/if_inet6")


@dataclass(frozen=True)
class Interface:
    """One interface that is up; ``addresses`` are numeric and not link-local."""

    index: int
    name: str
    addresses: tuple[str, ...]
    is_loopback: bool = False
    is_multicast: bool = True
    is_running: bool = True


def list_interfaces() -> list[Interface]:
    """Return the interfaces that are up; an empty list if the system does not report them."""
    found: list[Interface] = []
    ipv6_addresses = _read_ipv6_addresses()
    try:
        names = socket.if_nameindex()
        probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    except OSError:
        return found
    with probe:
        for index, name in names:
            request = struct.pack("40s", name.encode()[:15])
            try:
                flags = struct.unpack_from("H", fcntl.ioctl(probe, _FLAGS, request), 16)[0]
            except OSError:
                continue
            try:
                ipv4_addresses = [socket.inet_ntoa(fcntl.ioctl(probe, _ADDRESS, request)[20:24])]
            except OSError:
                ipv4_addresses = []
            if flags & _UP:
                addresses = (*ipv4_addresses, *ipv6_addresses.get(name, []))
                found.append(
                    Interface(
                        index,
                        name,
                        addresses,
                        bool(flags & _LOOPBACK),
                        bool(flags & (_MULTICAST | _LOOPBACK)),
                        bool(flags & _RUNNING),
                    )
                )
    return found


def select_interfaces(found: list[Interface], host: str) -> list[Interface]:
    """Return the interfaces in ``found`` at which a node that listens at ``host`` is reachable.

    The loopback is included only if there is no other interface, or if the node listens at a loopback address.
    """
    if not is_any(host):
        return [interface for interface in found if host in interface.addresses]
    usable = [i for i in found if i.is_multicast and i.addresses and not i.is_loopback]
    return usable or [i for i in found if i.is_loopback]


def is_any(host: str) -> bool:
    """Return whether ``host`` is an unspecified address, which means every interface."""
    return host in ("", "*", "0.0.0.0", "::")


def is_loopback(host: str) -> bool:
    """Return whether ``host`` is a loopback address."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def _read_ipv6_addresses() -> dict[str, list[str]]:
    """Return the IPv6 addresses of each interface, except link-local ones, which need a scope."""
    found: dict[str, list[str]] = {}
    try:
        lines = _ADDRESSES6.read_text(encoding="ascii").splitlines()
    except (OSError, ValueError):
        return found
    for line in lines:
        words = line.split()
        if len(words) == 6:
            address = IPv6Address(bytes.fromhex(words[0]))
            if not address.is_link_local:
                found.setdefault(words[5], []).append(str(address))
    return found
