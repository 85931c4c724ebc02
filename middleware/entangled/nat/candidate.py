"""Encode, decode and filter candidates: addresses at which a peer may be reachable.

This node sends datagrams to the candidates in a message, so multicast, broadcast and unspecified addresses are dropped.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address
from typing import NamedTuple

from middleware.entangled.network.network import Address

MAX_CANDIDATES = 6
"""The maximum number of addresses of one node in a message."""
_SMALL_NETWORK_BITS = 24
_SITE_RANGES: tuple[tuple[IPv4Network | IPv6Network, int], ...] = (
    (IPv4Network("10.0.0.0/8"), 16),
    (IPv4Network("172.16.0.0/12"), 16),
    (IPv4Network("192.168.0.0/16"), 16),
    (IPv4Network("169.254.0.0/16"), 16),
    (IPv6Network("fc00::/7"), 48),
    (IPv6Network("fe80::/10"), 10),
)
"""The ranges that RFC 1918, 3927, 4193 and 4291 reserve for one site or link, and the minimum length of the prefix that
the addresses of two neighbours have in common."""


def pack_candidates(addresses: Iterable[Address]) -> list[object]:
    """Encode addresses for a message, without duplicates."""
    return [[address.host, address.port] for address in list(dict.fromkeys(addresses))[:MAX_CANDIDATES]]


def parse_candidates(fields: object) -> list[Address]:
    """Decode the addresses in a message; impossible and invalid ones are skipped."""
    found: dict[Address, None] = {}
    for pair in fields[:MAX_CANDIDATES] if isinstance(fields, list) else ():
        if not (isinstance(pair, list) and len(pair) == 2):
            continue
        host, port = pair
        if isinstance(host, str) and type(port) is int and is_possible(Address(host, port)):
            found[Address(host, port)] = None
    return list(found)


def is_possible(address: Address) -> bool:
    """Return whether a peer can have this address; host names, multicast and unspecified addresses are excluded."""
    ip = _parse_ip(address.host)
    if ip is None or not 0 < address.port < 65536:
        return False
    return not (ip.is_multicast or ip.is_unspecified or ip == IPv4Address("255.255.255.255"))


def is_loopback(host: str) -> bool:
    """Return whether the host is a loopback address."""
    ip = _parse_ip(host)
    return ip is not None and ip.is_loopback


def is_near(host: str, own: str, is_translated: bool = False) -> bool:
    """Return whether ``host`` and ``own`` are one machine or neighbours in a private network, without NAT in between.

    If this node ``is_translated`` (a router translates its address), its private network is small and may be part of a
    larger network with the same range.  Then only addresses that differ in no more than the last byte are neighbours.
    """
    one, other = _parse_numeric(host), _parse_numeric(own)
    if one is None or other is None or one.version != other.version:
        return False
    if one.is_loopback or one.number == other.number:
        return True
    if not one.bits or one.site != other.site:
        return False
    apart = (32 if one.version == 4 else 128) - (
        _SMALL_NETWORK_BITS if is_translated and one.version == 4 else one.bits
    )
    return one.number >> apart == other.number >> apart


class _NumericAddress(NamedTuple):
    """An address as a number, and the index of its range in ``_SITE_RANGES``; ``bits`` is 0 if it is in no range."""

    version: int
    number: int
    is_loopback: bool
    site: int
    bits: int


@lru_cache(maxsize=4096)
def _parse_numeric(host: str) -> _NumericAddress | None:
    ip = _parse_ip(host)
    if ip is None:
        return None
    found = ((site, bits) for site, (network, bits) in enumerate(_SITE_RANGES) if ip in network)
    return _NumericAddress(ip.version, int(ip), ip.is_loopback, *next(found, (0, 0)))


@lru_cache(maxsize=1024)
def _parse_ip(host: str) -> IPv4Address | IPv6Address | None:
    try:
        return ip_address(host) if len(host) <= 45 else None
    except ValueError:
        return None
