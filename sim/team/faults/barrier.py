"""Block datagrams between some nodes of a switchboard (``switchboard.Barrier``)."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable

from middleware.entangled.network.network import Address


def isolate(hosts: Iterable[str]) -> Callable[[Address, Address], bool]:
    """Block all datagrams between ``hosts`` and other nodes; ``hosts`` can still reach each other."""
    inside = frozenset(hosts)
    return lambda source, to: (source.host in inside) != (to.host in inside)


def block_incoming(hosts: Iterable[str]) -> Callable[[Address, Address], bool]:
    """Block datagrams from other nodes to ``hosts``."""
    inside = frozenset(hosts)
    return lambda source, to: to.host in inside and source.host not in inside


def block_outgoing(hosts: Iterable[str]) -> Callable[[Address, Address], bool]:
    """Block datagrams from ``hosts`` to other nodes."""
    inside = frozenset(hosts)
    return lambda source, to: source.host in inside and to.host not in inside


def block_host(host: str) -> Callable[[Address, Address], bool]:
    """Block all datagrams from and to one host."""
    return lambda source, to: source.host == host or to.host == host


def block_pairs(share: float, salt: str) -> Callable[[Address, Address], bool]:
    """Block the share ``share`` of all pairs, selected by ``salt``; both nodes of a pair may reach a third node."""
    bound = int(share * 2**32)

    def stands(source: Address, to: Address) -> bool:
        a, b = sorted((source.host, to.host))
        return zlib.crc32(f"{salt} {a} {b}".encode()) < bound

    return stands
