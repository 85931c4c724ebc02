"""Candidate: an address at which a peer may be reached, and which of those that others name are worth a try.

Pure.  Whoever names an address makes us send to it, so what no peer can have is dropped: groups, everybody, nobody.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address
from typing import NamedTuple

from middleware.entangled.network.network import Address

MAX_CANDIDATES = 6
"""Addresses of one node in a message."""
_SMALL = 24
_OF_A_SITE: tuple[tuple[IPv4Network | IPv6Network, int], ...] = (
    (IPv4Network("10.0.0.0/8"), 16),
    (IPv4Network("172.16.0.0/12"), 16),
    (IPv4Network("192.168.0.0/16"), 16),
    (IPv4Network("169.254.0.0/16"), 16),
    (IPv6Network("fc00::/7"), 48),
    (IPv6Network("fe80::/10"), 10),
)
"""What RFC 1918, 3927, 4193 and 4291 keep for one site or link, and how many bits two neighbours share at least."""


def packed(addresses: Iterable[Address]) -> list[object]:
    """Addresses as they stand in a message, each once."""
    return [[address.host, address.port] for address in list(dict.fromkeys(addresses))[:MAX_CANDIDATES]]


def unpacked(fields: object) -> list[Address]:
    """The addresses in a message; those that no peer can have, or that are none, are left out."""
    found: dict[Address, None] = {}
    for pair in fields[:MAX_CANDIDATES] if isinstance(fields, list) else ():
        if not (isinstance(pair, list) and len(pair) == 2):
            continue
        host, port = pair
        if isinstance(host, str) and type(port) is int and is_possible(Address(host, port)):
            found[Address(host, port)] = None
    return list(found)


def is_possible(address: Address) -> bool:
    """Whether a peer can have this address; names, groups and the address that stands for any are none."""
    ip = _ip(address.host)
    if ip is None or not 0 < address.port < 65536:
        return False
    return not (ip.is_multicast or ip.is_unspecified or ip == IPv4Address("255.255.255.255"))


def is_loopback(host: str) -> bool:
    """Whether only this machine is reached there."""
    ip = _ip(host)
    return ip is not None and ip.is_loopback


def is_near(host: str, own: str, is_translated: bool = False) -> bool:
    """Whether nothing translates between ``host`` and ``own``: one machine, or neighbours in a site's own network.

    A node that ``is_translated`` by a router sits in a small network inside of a larger one, which may look the same:
    there only those count whose addresses differ in the last byte alone.
    """
    one, other = _place(host), _place(own)
    if one is None or other is None or one.version != other.version:
        return False
    if one.is_loopback or one.number == other.number:
        return True
    if not one.bits or one.site != other.site:
        return False
    apart = (32 if one.version == 4 else 128) - (_SMALL if is_translated and one.version == 4 else one.bits)
    return one.number >> apart == other.number >> apart


class _Place(NamedTuple):
    """An address as a number, and which of ``_OF_A_SITE`` it is in (with 0 ``bits``: in none)."""

    version: int
    number: int
    is_loopback: bool
    site: int
    bits: int


@lru_cache(maxsize=4096)
def _place(host: str) -> _Place | None:
    ip = _ip(host)
    if ip is None:
        return None
    found = ((site, bits) for site, (network, bits) in enumerate(_OF_A_SITE) if ip in network)
    return _Place(ip.version, int(ip), ip.is_loopback, *next(found, (0, 0)))


@lru_cache(maxsize=1024)
def _ip(host: str) -> IPv4Address | IPv6Address | None:
    try:
        return ip_address(host) if len(host) <= 45 else None
    except ValueError:
        return None
