"""A node of the examples: over UDP on this machine, with a key of its own that it forgets when it ends."""

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
"""A real team has 32 secret bytes here: who lacks them can neither read nor write."""


async def joined(reactor: Any, port: int, known: str = "") -> EntangledNode:
    """A node on ``port`` that has entered the network of ``known`` (HOST:PORT), or has begun one of its own."""
    use_monotonic_time()
    dice = random.SystemRandom()
    network = UdpNetwork(reactor, "127.0.0.1", port)
    node = EntangledNode(Identity(dice.randbytes(32)), TEAM_KEY, network, MemoryStore(), reactor, dice)
    node.start()
    reactor.addSystemEventTrigger("before", "shutdown", node.stop)
    host, _, number = known.rpartition(":")
    await node.join([Address(host, int(number))] if known else [])
    return node
