"""Fuzz an open port with arbitrary datagrams of a node outside the team, including changed recordings.

Such a datagram must change nothing, and its sender must get no more bytes than it sent.
"""

from __future__ import annotations

from tests.fuzz.ground import Ground, Violation
from tests.fuzz.runner import Again, main

RECORDED = 128


def datagram_of(data: bytes, recorded: list[bytes]) -> bytes:
    """Return the datagram that an input encodes.

    If the first byte is at least ``RECORDED``, it selects a recording; each following three bytes give the position and
    value of one change.
    """
    if not data or data[0] < RECORDED or not recorded:
        return data[1:]
    datagram = bytearray(recorded[(data[0] - RECORDED) % len(recorded)])
    for place in range(1, len(data) - 2, 3):
        where = int.from_bytes(data[place : place + 2], "little")
        if where >= 0xF000:
            del datagram[where - 0xF000 :]
        elif datagram:
            datagram[where % len(datagram)] ^= data[place + 2]
    return bytes(datagram)


def shot(ground: Ground, data: bytes) -> None:
    """Send one input to the target; raises ``Violation``."""
    datagram = datagram_of(data, ground.recorded)
    before = ground.known or ground.state()
    sent = ground.shoot(datagram)
    ground.known = ground.state()
    if sent > len(datagram):
        raise Violation(f"{sent} bytes sent for {len(datagram)} received")
    if ground.known != before:
        raise Violation("a stranger's datagram changed the node")


check = Again(shot)

if __name__ == "__main__":
    main("raw", check)
