"""Barrier: what keeps datagrams from passing between some nodes of a board (``switchboard.Barrier``)."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable

from middleware.entangled.network.network import Address


def cut(hosts: Iterable[str]) -> Callable[[Address, Address], bool]:
    """Nothing passes between ``hosts`` and all others; among themselves they are connected."""
    inside = frozenset(hosts)
    return lambda source, to: (source.host in inside) != (to.host in inside)


def deaf(hosts: Iterable[str]) -> Callable[[Address, Address], bool]:
    """Nothing from others comes in to ``hosts``, though they are heard."""
    inside = frozenset(hosts)
    return lambda source, to: to.host in inside and source.host not in inside


def mute(hosts: Iterable[str]) -> Callable[[Address, Address], bool]:
    """Nothing of ``hosts`` gets out to others, though they hear."""
    inside = frozenset(hosts)
    return lambda source, to: source.host in inside and to.host not in inside


def clog(host: str) -> Callable[[Address, Address], bool]:
    """One host is alone."""
    return lambda source, to: source.host == host or to.host == host


def pairs(share: float, salt: str) -> Callable[[Address, Address], bool]:
    """A ``share`` of all pairs cannot talk, which ones follows from ``salt``; both may well talk to a third."""
    bound = int(share * 2**32)

    def stands(source: Address, to: Address) -> bool:
        a, b = sorted((source.host, to.host))
        return zlib.crc32(f"{salt} {a} {b}".encode()) < bound

    return stands
