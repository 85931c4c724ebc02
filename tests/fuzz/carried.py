"""Fuzz the relayed and path messages of a member in a session.

Each input consists of several plaintexts, as in ``envelope``; the first byte of each selects the kind: CARRY to a
known or unknown node, CARRIED as if from a node, MIRROR, IMAGE. No input raises or is logged, a message for a node
without a session changes nothing, and the target sends no more than it received.
"""

from __future__ import annotations

from middleware.entangled.identity import node_id
from middleware.entangled.reach.mirror import IMAGE, MIRROR
from middleware.entangled.reach.relay import CARRIED, CARRY, MAX_PAIRS
from tests.fuzz.envelope import plaintexts
from tests.fuzz.ground import Ground, Violation
from tests.fuzz.runner import Again, main

KINDS = (CARRY, CARRIED, MIRROR, IMAGE)


def plain_of(ground: Ground, data: bytes) -> bytes:
    """Return the plaintext that some bytes encode."""
    first = data[0] if data else 0
    kind = KINDS[first % 4]
    known = (node_id(ground.identity.public), ground.contact.node_id, bytes(20), data[1:21])
    to = known[first // 4 % 4] if kind in (CARRY, CARRIED) else b""
    inner = data[1:]
    if first >= 128 and ground.recorded:
        inner = ground.recorded[first % len(ground.recorded)]
    return bytes([kind]) + to + inner


def shot(ground: Ground, data: bytes) -> None:
    """Send one input; raises ``Violation``."""
    session = next(iter(ground.other._sessions.values()))
    for each in plaintexts(data):
        plain = plain_of(ground, each)[:1423]
        ground.shoot(session.seal(plain), ground.other.address)
        if sum(len(datagram) for datagram, _ in ground.sent) > 2 * len(plain) + 1600:
            raise Violation("much more was sent than came")
        if len(ground.node.reach.relay) > MAX_PAIRS:
            raise Violation("more pairs than there is room for")
    ground.clock.advance(0.05)


check = Again(shot, period=100)

if __name__ == "__main__":
    main("carried", check)
