"""Bundle: the connections of one tunnel: one, and on a line that loses much up to three that carry the same.

A stream stands still while what was lost is repeated, each time later: with 30 % lost each way often for seconds, and
what is behind it is late.  Streams beside each other seldom stand still together.  So while one of them did so of late
there are three, and a datagram goes by the two that move; whoever hears it twice drops the second, as the wire does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from middleware.entangled.network.carrier import Strain
from middleware.entangled.network.link import Link
from middleware.entangled.network.network import Address

MOST = 3
"""Connections of one tunnel."""
AT_ONCE = 2
"""Connections by which a datagram goes, where there are several."""
STILL_S = 0.3
"""A stream that repeats itself and has got nothing through for so long stands still."""
DEAD_S = 1.5
"""One that stands still for so long is dialled anew, if another one moves."""
HARD = 2
"""Who had to repeat itself so often until it was open has a line that loses much."""
ROUGH_S = 30.0
"""So long after a stream stood still there are several."""
OPENING_S = 1.2
"""Where none opens for so long another one is dialled beside it."""
AGAIN_S = 1.0
"""Seconds at least between a connection that was lost and the next one, where there are others."""
HELD = 4096
"""Bytes in a stream that stands still; what comes beyond would be late, and make what comes after it late."""

Measure = Callable[[Any], Strain | None]


@dataclass(slots=True)
class _Pace:
    """When a stream last got something through, and what was confirmed and repeated by then."""

    moved_at: float
    acked: int = -1
    repeated: int = 0
    held: int = 0
    is_repeating: bool = False


class Bundle:
    """The connections of the tunnel to ``address``; ``measure`` says how the stream of a transport does."""

    def __init__(self, address: Address, measure: Measure, now: float) -> None:
        self.address = address
        self.token = b""
        """By what the other end knows which connections are of one tunnel."""
        self.links: list[Link] = []
        self.is_answered = False
        self.begun_at = self.carried_at = now
        self.hold_until = float("-inf")
        self._measure = measure
        self._rough_until = float("-inf")
        self._paces: dict[Link, _Pace] = {}

    @property
    def is_open(self) -> bool:
        """Whether datagrams pass."""
        return any(link.is_open for link in self.links)

    def add(self, link: Link) -> None:
        """Take in a connection."""
        self.links.append(link)

    def remove(self, link: Link, now: float) -> None:
        """Let go of a connection."""
        if link in self.links:
            self.links.remove(link)
            self.hold_until = now + AGAIN_S
        self._paces.pop(link, None)

    def send(self, datagram: bytes, now: float) -> bool:
        """Send a datagram by the connections that move; False where it was dropped."""
        self.is_answered, self.carried_at = True, now
        links = self.liveliest(now) or self.links[:1]
        sent = 0
        for link in links:
            pace = self._paces.get(link)
            if pace is not None and self._stands(pace, now) and pace.held > HELD:
                continue
            dropped = link.dropped
            link.send(datagram)
            sent += link.dropped == dropped
            if sent == AT_ONCE:
                break
        return sent > 0

    def liveliest(self, now: float) -> list[Link]:
        """The open connections, those that move and hold least first."""
        links = [link for link in self.links if link.is_open]
        for link in links:
            self._look(link, now)
        if len(links) > 1:
            links.sort(key=lambda link: self._order(self._paces[link], now))
        return links

    def stillest(self, now: float) -> Link:
        """Of all but the newest connection the one to do without, the oldest where all move."""
        self.liveliest(now)
        return max(self.links[:-1], key=lambda link: self._order(self._paces.get(link) or _Pace(now), now))

    def wanted(self, now: float) -> int:
        """How many connections there should be."""
        if not self.is_open:
            return min(MOST, 1 + int((now - self.begun_at) / OPENING_S))
        return MOST if now < self._rough_until else 1

    def dead(self, now: float) -> list[Link]:
        """Connections that stand still, or are not wanted any more."""
        links = self.liveliest(now)
        if not links:
            return []
        if self.wanted(now) == 1:
            return [link for link in self.links if link is not links[0]]
        if self._stands(self._paces[links[0]], now):
            return []
        return [link for link in links if self._still_s(self._paces[link], now) > DEAD_S]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _look(self, link: Link, now: float) -> None:
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
        if self._stands(pace, now):
            self._rough_until = now + ROUGH_S

    def _still_s(self, pace: _Pace, now: float) -> float:
        return now - pace.moved_at if pace.held else 0.0

    def _stands(self, pace: _Pace, now: float) -> bool:
        return pace.is_repeating and self._still_s(pace, now) > STILL_S

    def _order(self, pace: _Pace, now: float) -> tuple[bool, float, int]:
        return self._stands(pace, now), self._still_s(pace, now), pace.held
