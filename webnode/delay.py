"""Delay: who has guessed wrong too often waits, ever longer; nobody else does.  Pure."""

from __future__ import annotations

import ipaddress
from collections import OrderedDict

FREE = 10
FIRST_S, LONGEST_S = 4.0, 3600.0
FORGOTTEN_S = 86400.0
SOURCES = 4096


class Delays:
    """Tries that went wrong, by the address that they came from; ``now`` is in seconds.

    Ten are free; then 4 s, 8 s and so on up to an hour pass before the next: at most 20 guesses in an hour.  An address
    that has been quiet for a day is forgotten, and so is the one that is quiet for longest where there are too many.
    Other numbers than these can be given.
    """

    def __init__(self, free: int = FREE, longest_s: float = LONGEST_S, forgotten_s: float = FORGOTTEN_S) -> None:
        self._free = free
        self._longest_s = longest_s
        self._forgotten_s = forgotten_s
        self._tries: OrderedDict[str, tuple[int, float]] = OrderedDict()

    def wait(self, source: str, now: float) -> float:
        """Seconds until ``source`` may try again; 0 where it may now."""
        count, last = self._tries.get(network_of(source), (0, 0.0))
        if count < self._free or now - last >= self._forgotten_s:
            return 0.0
        pause = min(self._longest_s, FIRST_S * 2.0 ** min(count - self._free, 20))
        # A clock that was set back must not make anybody wait for longer than the pause.
        return max(0.0, min(pause, last + pause - now))

    def tried(self, source: str, now: float) -> None:
        """Count a try; before its outcome is known, so that a hundred at once are a hundred."""
        key = network_of(source)
        count, last = self._tries.pop(key, (0, now))
        self._tries[key] = (1 if now - last >= self._forgotten_s else count + 1, now)
        if len(self._tries) > SOURCES:
            self._tries.popitem(last=False)

    def held(self, source: str) -> None:
        """Forget the tries of ``source``: one was right."""
        self._tries.pop(network_of(source), None)

    def undo(self, source: str) -> None:
        """Take the last try of ``source`` back: it was right, and says nothing of the others."""
        key = network_of(source)
        if key in self._tries:
            count, last = self._tries[key]
            self._tries[key] = max(0, count - 1), last


def network_of(source: str) -> str:
    """What counts as one address: whoever has one of IPv6 has 2^64 of them."""
    try:
        address = ipaddress.ip_address(source.partition("%")[0])
    except ValueError:
        return source
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is not None:
            return str(address.ipv4_mapped)
        return str(ipaddress.ip_network((int(address), 64), strict=False).network_address)
    return str(address)
