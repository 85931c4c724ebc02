"""A node for the examples, which uses UDP on this machine and a new key for each run."""

from __future__ import annotations

import random
from typing import Any

from middleware.entangled.clock import use_monotonic_time
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.network.udp import UdpNetwork
from middleware.entangled.node import EntangledNode

TEAM_KEY = b"everybody who runs the examples."
"""Use 32 secret bytes in a real team: a node that does not know them can neither read nor write records."""


async def joined(reactor: Any, port: int, known: str = "") -> EntangledNode:
    """Start a node on ``port`` that joins the network of ``known`` (HOST:PORT), or starts a new one."""
    use_monotonic_time()
    rng = random.SystemRandom()
    network = UdpNetwork(reactor, "127.0.0.1", port)
    node = EntangledNode(Identity(rng.randbytes(32)), TEAM_KEY, network, MemoryStore(), reactor, rng)
    node.start()
    reactor.addSystemEventTrigger("before", "shutdown", node.stop)
    host, _, number = known.rpartition(":")
    await node.join([Address(host, int(number))] if known else [])
    return node
