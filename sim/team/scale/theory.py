"""Theory: what the curves should look like by arithmetic, and by simulations that were published; pure.

Simulated figures of the own notes on consensus stand where no others are known; what is another's has its source.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

from middleware.entangled.kademlia.overlay import K

Theory = Callable[[float], float]


class Published(NamedTuple):
    """A figure of somebody else: at ``nodes`` nodes it was ``value``."""

    nodes: int
    value: float
    who: str


def hops(nodes: float) -> float:
    """What lookups are held to: half of the bits that tell so many nodes apart.

    Two at least: who is asked names others, and these are asked whether they are there.
    """
    return max(2.0, math.log2(nodes) / 2)


def contacts(nodes: float) -> float:
    """Contacts in a full table: k out of each half, quarter, ... until fewer are left."""
    found, left = 0.0, nodes
    while left > 1:
        left /= 2
        found += min(float(K), left)
    return min(found, nodes - 1)


def tree(nodes: float) -> float:
    """Datagrams a node on a tree: a bid up and an announcement down each link, both confirmed."""
    return 4 * (nodes - 1) / nodes


ROUND = 0.03
"""Mean seconds of one way on the link of these simulations."""
_ROUNDS = {3: 3.2, 10: 5.8, 30: 10, 100: 15, 300: 19, 1000: 24, 3000: 29, 10_000: 32.5}
_HOT = {3: 6, 10: 20, 30: 46, 100: 72, 300: 101, 1000: 126, 3000: 152, 10_000: 183}


def agreement(nodes: float) -> float:
    """Seconds until all agree at 10 % loss, by the simulated rounds of bids that go along Kademlia's hops."""
    return ROUND * _between(_ROUNDS, nodes)


def busiest(nodes: float) -> float:
    """Messages at the busiest node of the same simulation, without loss."""
    return _between(_HOT, nodes)


def takeover(nodes: float) -> float:
    """Seconds of half of the takeovers by the simulated lease of 1.5 s at 10 % loss: the team's size is not in it."""
    return 1.41


def share(nodes: float) -> float:
    """The share of a directory that each of k holders has where it is spread over all nodes evenly."""
    return min(1.0, K / nodes)


def _between(known: Mapping[int, float], nodes: float) -> float:
    """A value between the known sizes, by the logarithm of the size."""
    sizes = sorted(known)
    for low, high in zip(sizes, sizes[1:], strict=False):
        if nodes <= high:
            part = math.log(max(nodes, low) / low) / math.log(high / low)
            return known[low] + part * (known[high] - known[low])
    return known[sizes[-1]]
