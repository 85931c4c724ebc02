"""Fresh port: a further local port, from which a node knocks where early knocks may have spoilt its usual one."""

from __future__ import annotations

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.reach.path import PathNetwork
from middleware.entangled.reach.way import HELD_S, Ways

MAX_FRESH = 16
"""Fresh local ports at the same time."""
SHUT_S = 60.0
"""Seconds after which a fresh port is closed where no session goes by it."""


class FreshPorts:
    """The fresh ports of a node, and when each was opened."""

    def __init__(self, paths: PathNetwork, ways: Ways, clock: IReactorTime) -> None:
        self._paths = paths
        self._ways = ways
        self._clock = clock
        self._opened_at: dict[int, float] = {}

    def __len__(self) -> int:
        return len(self._opened_at)

    def __contains__(self, port: int) -> bool:
        return port in self._opened_at

    def open(self) -> int:
        """A fresh local port; 0 where there are too many."""
        now = self._clock.seconds()
        if len(self._opened_at) >= MAX_FRESH:
            unused = self._unused_since(now - HELD_S)
            if not unused:
                return 0
            self._shut(unused[0])
        port = self._paths.open_port()
        if port:
            self._opened_at[port] = now
        return port

    def shut_unused(self, now: float) -> None:
        """Close those that were opened long ago, and by which no session goes."""
        for port in self._unused_since(now - SHUT_S):
            self._shut(port)

    def _unused_since(self, before: float) -> list[int]:
        """Those by which no session goes though they were opened before that moment, the oldest first."""
        return [port for port, at in self._opened_at.items() if at < before and not self._ways.uses(port)]

    def _shut(self, port: int) -> None:
        del self._opened_at[port]
        self._paths.shut_port(port)
