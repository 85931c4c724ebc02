"""Fuzz the encrypted messages that a member sends in a session: a malformed message must change nothing.

An input encodes several datagrams. The plaintext of each datagram is preceded by its length in two bytes.
"""

from __future__ import annotations

from middleware.entangled.wire.message import PART
from tests.fuzz.ground import Ground, Violation, state_of
from tests.fuzz.runner import Again, main

MAX_SHOTS = 8


def plaintexts(data: bytes) -> list[bytes]:
    """Return the plaintexts that an input encodes."""
    found: list[bytes] = []
    while data and len(found) < MAX_SHOTS:
        length = int.from_bytes(data[:2], "little") % 1372
        found.append(data[2 : 2 + length])
        data = data[2 + length :]
    return found


def shot(ground: Ground, data: bytes) -> None:
    """Send one input to the target; raises ``Violation``."""
    session = next(iter(ground.other._sessions.values()))
    for plain in plaintexts(data):
        counted = ground.target.counters["malformed"]
        before = _lasting(ground)
        ground.shoot(session.seal(plain), ground.other.address)
        # The last fragment of a message completes the message and so changes the state, whatever the content is.
        is_whole = plain[:1] != bytes([PART])
        if is_whole and ground.target.counters["malformed"] > counted and _lasting(ground) != before:
            raise Violation("a malformed message changed the node")
    ground.clock.advance(0.01)


def _lasting(ground: Ground) -> str:
    """Return the hash of the state, except the session of the datagram, because its counters always change."""
    target, node = ground.target, ground.node
    session = next(iter(target._sessions.values()), None)
    half_open = [target._half_open._responses, list(target._half_open._unconfirmed)]
    calls = [
        target._fragmenter,
        target._dispatcher._history,
        target._dispatcher._cancelled,
        target._requester._requests,
    ]
    timers = sorted(call.getTime() for call in ground.clock.getDelayedCalls())
    return state_of([node.overlay.table, ground.store, half_open, calls, timers], without=session)


check = Again(shot)

if __name__ == "__main__":
    main("envelope", check)
