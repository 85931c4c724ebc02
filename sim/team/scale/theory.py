"""Theoretical values of the curves, and values of published simulations.  Pure.

If no published values are known, values of this project's simulations of consensus are used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

from middleware.entangled.kademlia.overlay import K

Theory = Callable[[float], float]


class Published(NamedTuple):
    """A published value: ``value`` at ``nodes`` nodes, by ``source``."""

    nodes: int
    value: float
    source: str


def hops(nodes: float) -> float:
    """Return the target for the hops of a lookup: half of the bits that distinguish so many nodes.

    At least two hops: the first finds the address of the target, and the second confirms that the target is alive.
    """
    return max(2.0, math.log2(nodes) / 2)


def contacts(nodes: float) -> float:
    """Return the contacts in a full routing table: k from each half, quarter, ... of the ids with at least k nodes."""
    found, left = 0.0, nodes
    while left > 1:
        left /= 2
        found += min(float(K), left)
    return min(found, nodes - 1)


def tree(nodes: float) -> float:
    """Return the datagrams per node on a tree: a bid up and an announcement down each link, both acknowledged."""
    return 4 * (nodes - 1) / nodes


ROUND_S = 0.03
"""Mean one-way delay in seconds of the link in these simulations."""
_ROUNDS = {3: 3.2, 10: 5.8, 30: 10, 100: 15, 300: 19, 1000: 24, 3000: 29, 10_000: 32.5}
_BUSIEST = {3: 6, 10: 20, 30: 46, 100: 72, 300: 101, 1000: 126, 3000: 152, 10_000: 183}


def agreement(nodes: float) -> float:
    """Return seconds until all agree at 10 % loss, by simulated rounds of bids along Kademlia's hops."""
    return ROUND_S * _interpolate(_ROUNDS, nodes)


def busiest(nodes: float) -> float:
    """Return the messages at the busiest node in the simulation of ``agreement``, without loss."""
    return _interpolate(_BUSIEST, nodes)


def takeover(nodes: float) -> float:
    """Return the median takeover time in seconds of a simulated lease of 1.5 s at 10 % loss, for any team size."""
    return 1.41


def share(nodes: float) -> float:
    """Return the share of the directory at each node, if k copies are spread evenly over all nodes."""
    return min(1.0, K / nodes)


def _interpolate(known: Mapping[int, float], nodes: float) -> float:
    """Interpolate between the known sizes by the logarithm of the size."""
    sizes = sorted(known)
    for low, high in zip(sizes, sizes[1:], strict=False):
        if nodes <= high:
            part = math.log(max(nodes, low) / low) / math.log(high / low)
            return known[low] + part * (known[high] - known[low])
    return known[sizes[-1]]
