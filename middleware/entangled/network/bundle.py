"""Manage the connections of one tunnel: one, or up to three redundant ones on a lossy path.

A TCP stream stalls while lost segments are retransmitted, often for seconds at 30 % loss in each direction, and
everything behind them is delayed.  Parallel streams seldom stall at the same time.  Therefore a tunnel has three
connections after a recent stall, and sends each datagram over the two that make progress; the receiving endpoint drops
duplicates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from middleware.entangled.network.carrier import Strain
from middleware.entangled.network.link import Link
from middleware.entangled.network.network import Address

MOST = 3
"""The maximum number of connections of one tunnel."""
AT_ONCE = 2
"""The number of connections that carry each datagram, if there are several."""
STILL_S = 0.3
"""The time in seconds after which a stream that retransmits without progress counts as stalled."""
DEAD_S = 1.5
"""The time in seconds after which a stalled stream is dialled again, if another one makes progress."""
HARD = 2
"""The number of retransmissions before a stream is open that indicates a lossy path."""
ROUGH_S = 30.0
"""The time in seconds for which a tunnel has several connections after a stall."""
OPENING_S = 1.2
"""The time in seconds after which another connection is dialled if none opens."""
AGAIN_S = 1.0
"""The minimum time in seconds between the loss of a connection and the next one, if there are others."""
HELD = 4096
"""The bytes that a stalled stream may hold; further datagrams would be late and delay the ones after them."""

Measure = Callable[[Any], Strain | None]


@dataclass(slots=True)
class _Pace:
    """The progress of a stream: when it last delivered something, and its counts at that time."""

    moved_at: float
    acked: int = -1
    repeated: int = 0
    held: int = 0
    is_repeating: bool = False


class Bundle:
    """The connections of the tunnel to ``address``; ``measure`` returns the state of a transport's stream."""

    def __init__(self, address: Address, measure: Measure, now: float) -> None:
        self.address = address
        self.token = b""
        """Identifies the tunnel to the other end, which groups its connections by it."""
        self.links: list[Link] = []
        self.is_answered = False
        self.begun_at = self.carried_at = now
        self.hold_until = float("-inf")
        self._measure = measure
        self._rough_until = float("-inf")
        self._paces: dict[Link, _Pace] = {}

    @property
    def is_open(self) -> bool:
        """Whether datagrams can be sent."""
        return any(link.is_open for link in self.links)

    def add(self, link: Link) -> None:
        """Add a connection."""
        self.links.append(link)

    def remove(self, link: Link, now: float) -> None:
        """Remove a connection."""
        if link in self.links:
            self.links.remove(link)
            self.hold_until = now + AGAIN_S
        self._paces.pop(link, None)

    def send(self, datagram: bytes, now: float) -> bool:
        """Send a datagram over the connections that make progress; return False if it was dropped."""
        self.is_answered, self.carried_at = True, now
        links = self.liveliest(now) or self.links[:1]
        sent = 0
        for link in links:
            pace = self._paces.get(link)
            if pace is not None and self._is_stalled(pace, now) and pace.held > HELD:
                continue
            dropped = link.dropped
            link.send(datagram)
            sent += link.dropped == dropped
            if sent == AT_ONCE:
                break
        return sent > 0

    def liveliest(self, now: float) -> list[Link]:
        """Return the open connections, first the ones that make progress and hold the fewest bytes."""
        links = [link for link in self.links if link.is_open]
        for link in links:
            self._measure_progress(link, now)
        if len(links) > 1:
            links.sort(key=lambda link: self._rank(self._paces[link], now))
        return links

    def stillest(self, now: float) -> Link:
        """Return the most stalled connection except the newest, or the oldest if none is stalled."""
        self.liveliest(now)
        return max(self.links[:-1], key=lambda link: self._rank(self._paces.get(link) or _Pace(now), now))

    def wanted(self, now: float) -> int:
        """Return the number of connections that the tunnel should have."""
        if not self.is_open:
            return min(MOST, 1 + int((now - self.begun_at) / OPENING_S))
        return MOST if now < self._rough_until else 1

    def dead(self, now: float) -> list[Link]:
        """Return the connections to close: stalled ones, and surplus ones."""
        links = self.liveliest(now)
        if not links:
            return []
        if self.wanted(now) == 1:
            return [link for link in self.links if link is not links[0]]
        if self._is_stalled(self._paces[links[0]], now):
            return []
        return [link for link in links if self._stalled_s(self._paces[link], now) > DEAD_S]

    # -- private ----------------------------------------------------------------------------------------------------

    def _measure_progress(self, link: Link, now: float) -> None:
        pace = self._paces.setdefault(link, _Pace(now))
        strain = self._measure(link.transport)
        if strain is None:
            return
        if pace.acked < 0 and strain.repeated >= HARD:
            self._rough_until = now + ROUGH_S
        if strain.acked != pace.acked or not strain.held:
            pace.moved_at, pace.acked, pace.repeated = now, strain.acked, strain.repeated
        pace.held = strain.held
        pace.is_repeating = strain.repeated > pace.repeated
        if self._is_stalled(pace, now):
            self._rough_until = now + ROUGH_S

    def _stalled_s(self, pace: _Pace, now: float) -> float:
        return now - pace.moved_at if pace.held else 0.0

    def _is_stalled(self, pace: _Pace, now: float) -> bool:
        return pace.is_repeating and self._stalled_s(pace, now) > STILL_S

    def _rank(self, pace: _Pace, now: float) -> tuple[bool, float, int]:
        return self._is_stalled(pace, now), self._stalled_s(pace, now), pace.held
