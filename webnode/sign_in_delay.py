"""Delay sign-in attempts of an address with too many failures, with exponential backoff.  Pure."""

from __future__ import annotations

import ipaddress
from collections import OrderedDict

FREE_ATTEMPTS = 10
FIRST_S, LONGEST_S = 4.0, 3600.0
FORGET_S = 86400.0
MAX_SOURCES = 4096


class SignInDelays:
    """Failed attempts per source address; ``now`` is in seconds.

    Ten attempts are free. The pause before the next attempt is then 4 s, and doubles with each attempt up to an hour,
    which limits guesses to 20 in the first hour.  An address is forgotten after a day without an attempt; if there are
    too many addresses, the one idle for longest is forgotten first.  The arguments replace these defaults.
    """

    def __init__(self, free: int = FREE_ATTEMPTS, longest_s: float = LONGEST_S, forgotten_s: float = FORGET_S) -> None:
        self._free = free
        self._longest_s = longest_s
        self._forgotten_s = forgotten_s
        self._attempts: OrderedDict[str, tuple[int, float]] = OrderedDict()

    def get_wait(self, source: str, now: float) -> float:
        """Return the seconds until ``source`` may try again; 0 if it may now."""
        count, last = self._attempts.get(get_network(source), (0, 0.0))
        if count < self._free or now - last >= self._forgotten_s:
            return 0.0
        pause = min(self._longest_s, FIRST_S * 2.0 ** min(count - self._free, 20))
        # If the clock was set back, the wait must not exceed the pause.
        return max(0.0, min(pause, last + pause - now))

    def count_attempt(self, source: str, now: float) -> None:
        """Count an attempt before its outcome is known, so concurrent attempts are counted, too."""
        key = get_network(source)
        count, last = self._attempts.pop(key, (0, now))
        self._attempts[key] = (1 if now - last >= self._forgotten_s else count + 1, now)
        if len(self._attempts) > MAX_SOURCES:
            self._attempts.popitem(last=False)

    def forget(self, source: str) -> None:
        """Forget the attempts of ``source`` after a success."""
        self._attempts.pop(get_network(source), None)

    def uncount_attempt(self, source: str) -> None:
        """Uncount the last attempt of ``source``, because it succeeded; the earlier attempts still count."""
        key = get_network(source)
        if key in self._attempts:
            count, last = self._attempts[key]
            self._attempts[key] = max(0, count - 1), last


def get_network(source: str) -> str:
    """Return the network that counts as one source: the /64 of an IPv6 address, because a client has the whole /64."""
    try:
        address = ipaddress.ip_address(source.partition("%")[0])
    except ValueError:
        return source
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is not None:
            return str(address.ipv4_mapped)
        return str(ipaddress.ip_network((int(address), 64), strict=False).network_address)
    return str(address)
