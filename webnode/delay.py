"""Delay sign-in attempts of an address with too many failures, with exponential backoff.  Pure."""

from __future__ import annotations

import ipaddress
from collections import OrderedDict

FREE = 10
FIRST_S, LONGEST_S = 4.0, 3600.0
FORGOTTEN_S = 86400.0
SOURCES = 4096


class Delays:
    """Failed attempts per source address; ``now`` is in seconds.

    Ten attempts are free; then the pause before the next doubles from 4 s up to an hour, which limits guesses to 20 in
    the first hour.  An address is forgotten after a day without an attempt; if there are too many addresses, the one
    idle for longest is forgotten first.  The arguments replace these defaults.
    """

    def __init__(self, free: int = FREE, longest_s: float = LONGEST_S, forgotten_s: float = FORGOTTEN_S) -> None:
        self._free = free
        self._longest_s = longest_s
        self._forgotten_s = forgotten_s
        self._tries: OrderedDict[str, tuple[int, float]] = OrderedDict()

    def wait(self, source: str, now: float) -> float:
        """Return the seconds until ``source`` may try again; 0 if it may now."""
        count, last = self._tries.get(network_of(source), (0, 0.0))
        if count < self._free or now - last >= self._forgotten_s:
            return 0.0
        pause = min(self._longest_s, FIRST_S * 2.0 ** min(count - self._free, 20))
        # If the clock was set back, the wait must not exceed the pause.
        return max(0.0, min(pause, last + pause - now))

    def tried(self, source: str, now: float) -> None:
        """Count an attempt before its outcome is known, so that concurrent attempts all count."""
        key = network_of(source)
        count, last = self._tries.pop(key, (0, now))
        self._tries[key] = (1 if now - last >= self._forgotten_s else count + 1, now)
        if len(self._tries) > SOURCES:
            self._tries.popitem(last=False)

    def held(self, source: str) -> None:
        """Forget the attempts of ``source`` after a success."""
        self._tries.pop(network_of(source), None)

    def undo(self, source: str) -> None:
        """Uncount the last attempt of ``source``: it succeeded, which says nothing about the earlier ones."""
        key = network_of(source)
        if key in self._tries:
            count, last = self._tries[key]
            self._tries[key] = max(0, count - 1), last


def network_of(source: str) -> str:
    """Return the network that counts as one source: the /64 of an IPv6 address, since a client owns all of it."""
    try:
        address = ipaddress.ip_address(source.partition("%")[0])
    except ValueError:
        return source
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is not None:
            return str(address.ipv4_mapped)
        return str(ipaddress.ip_network((int(address), 64), strict=False).network_address)
    return str(address)
