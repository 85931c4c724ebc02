"""Fuzz the messages for relays and paths that a member sends in a session.

Each input consists of several plaintexts, as in ``envelope``. The first byte of each plaintext selects its kind:
RELAY_REQUEST to a known or unknown node, RELAYED_DATAGRAM as if from a node, ADDRESS_REQUEST or ADDRESS_REPLY. No input
may raise an exception or cause a log line. A message for a node without a session must change nothing. The target must
send little more than it receives.
"""

from __future__ import annotations

from middleware.entangled.identity import derive_node_id
from middleware.entangled.nat.address_query import ADDRESS_REPLY, ADDRESS_REQUEST
from middleware.entangled.nat.relay import MAX_PAIRS, RELAY_REQUEST, RELAYED_DATAGRAM
from tests.fuzz.envelope import plaintexts
from tests.fuzz.ground import Ground, Violation
from tests.fuzz.runner import Again, main

KINDS = (RELAY_REQUEST, RELAYED_DATAGRAM, ADDRESS_REQUEST, ADDRESS_REPLY)


def plain_of(ground: Ground, data: bytes) -> bytes:
    """Return the plaintext that ``data`` encodes."""
    first = data[0] if data else 0
    kind = KINDS[first % 4]
    known = (derive_node_id(ground.identity.public), ground.contact.node_id, bytes(20), data[1:21])
    to = known[first // 4 % 4] if kind in (RELAY_REQUEST, RELAYED_DATAGRAM) else b""
    inner = data[1:]
    if first >= 128 and ground.recorded:
        inner = ground.recorded[first % len(ground.recorded)]
    return bytes([kind]) + to + inner


def shot(ground: Ground, data: bytes) -> None:
    """Send one input to the target; raises ``Violation``."""
    session = next(iter(ground.other._sessions.values()))
    for each in plaintexts(data):
        plain = plain_of(ground, each)[:1423]
        ground.shoot(session.seal(plain), ground.other.address)
        if sum(len(datagram) for datagram, _ in ground.sent) > 2 * len(plain) + 1600:
            raise Violation("much more was sent than came")
        if len(ground.node.nat.relay) > MAX_PAIRS:
            raise Violation("more pairs than there is room for")
    ground.clock.advance(0.05)


check = Again(shot, period=100)

if __name__ == "__main__":
    main("carried", check)
