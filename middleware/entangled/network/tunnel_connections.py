"""Manage the connections of one tunnel: one, or up to three redundant connections on a lossy path.

A TCP stream stalls while lost segments are retransmitted, often for seconds at 30 % loss in each direction, and all
later segments are delayed.  Parallel streams seldom stall at the same time.  Therefore a tunnel uses three connections
after a recent stall, and sends each datagram over two connections that make progress; the receiving endpoint drops
duplicates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from middleware.entangled.network.network import Address
from middleware.entangled.network.stream_transport import StreamState
from middleware.entangled.network.tunnel_connection import TunnelConnection

MAX_CONNECTIONS = 3
"""The maximum number of connections of one tunnel."""
COPIES = 2
"""The number of connections over which each datagram is sent, if the tunnel has several."""
STALLED_S = 0.3
"""The time in seconds after which a stream that retransmits without progress is considered stalled."""
REPLACE_STALLED_S = 1.5
"""The time in seconds after which a stalled stream is replaced by a new one, if another stream makes progress."""
LOSSY_RETRANSMISSIONS = 2
"""If this number of retransmissions occurs before the stream is open, the path is considered lossy."""
REDUNDANCY_S = 30.0
"""The time in seconds for which a tunnel has several connections after a stall."""
DIAL_NEXT_S = 1.2
"""If no connection opens within this time in seconds, another connection is dialled."""
REDIAL_DELAY_S = 1.0
"""The minimum time in seconds between the loss of a connection and the next dialling, if the tunnel has other
connections."""
MAX_STALLED_BYTES = 4096
"""The bytes that a stalled stream may buffer; further datagrams would be late and would delay later datagrams."""

ReadState = Callable[[Any], StreamState | None]


@dataclass(slots=True)
class _Progress:
    """The progress of a stream: the time when it last delivered bytes, and its counters at that time."""

    moved_at: float
    acked: int = -1
    retransmissions: int = 0
    unacked: int = 0
    is_retransmitting: bool = False


class TunnelConnections:
    """The connections of the tunnel to ``address``; ``read_state`` returns the state of a transport's stream."""

    def __init__(self, address: Address, read_state: ReadState, now: float) -> None:
        self.address = address
        self.token = b""
        """Identifies the tunnel: the other end groups connections with the same token."""
        self.connections: list[TunnelConnection] = []
        self.is_answered = False
        self.started_at = self.active_at = now
        self.hold_until = float("-inf")
        self._read_state = read_state
        self._redundant_until = float("-inf")
        self._progress: dict[TunnelConnection, _Progress] = {}

    @property
    def is_open(self) -> bool:
        """Whether datagrams can be sent."""
        return any(connection.is_open for connection in self.connections)

    def add(self, connection: TunnelConnection) -> None:
        """Add a connection."""
        self.connections.append(connection)

    def remove(self, connection: TunnelConnection, now: float) -> None:
        """Remove a connection."""
        if connection in self.connections:
            self.connections.remove(connection)
            self.hold_until = now + REDIAL_DELAY_S
        self._progress.pop(connection, None)

    def send(self, datagram: bytes, now: float) -> bool:
        """Send a datagram over the connections that make progress; return False if it was dropped."""
        self.is_answered, self.active_at = True, now
        connections = self.order_by_progress(now) or self.connections[:1]
        sent = 0
        for connection in connections:
            pace = self._progress.get(connection)
            if pace is not None and self._is_stalled(pace, now) and pace.unacked > MAX_STALLED_BYTES:
                continue
            dropped = connection.dropped
            connection.send(datagram)
            sent += connection.dropped == dropped
            if sent == COPIES:
                break
        return sent > 0

    def order_by_progress(self, now: float) -> list[TunnelConnection]:
        """Return the open connections: those with progress first, and of equals the one with fewer buffered bytes."""
        connections = [connection for connection in self.connections if connection.is_open]
        for connection in connections:
            self._measure_progress(connection, now)
        if len(connections) > 1:
            connections.sort(key=lambda connection: self._rank(self._progress[connection], now))
        return connections

    def find_most_stalled(self, now: float) -> TunnelConnection:
        """Return the most stalled connection except the newest, or the oldest if none is stalled."""
        self.order_by_progress(now)
        return max(
            self.connections[:-1],
            key=lambda connection: self._rank(self._progress.get(connection) or _Progress(now), now),
        )

    def target_count(self, now: float) -> int:
        """Return the number of connections that the tunnel should have."""
        if not self.is_open:
            return min(MAX_CONNECTIONS, 1 + int((now - self.started_at) / DIAL_NEXT_S))
        return MAX_CONNECTIONS if now < self._redundant_until else 1

    def find_surplus(self, now: float) -> list[TunnelConnection]:
        """Return the connections to close: stalled ones, and surplus ones."""
        connections = self.order_by_progress(now)
        if not connections:
            return []
        if self.target_count(now) == 1:
            return [connection for connection in self.connections if connection is not connections[0]]
        if self._is_stalled(self._progress[connections[0]], now):
            return []
        return [
            connection
            for connection in connections
            if self._stalled_s(self._progress[connection], now) > REPLACE_STALLED_S
        ]

    # -- private ----------------------------------------------------------------------------------------------------

    def _measure_progress(self, connection: TunnelConnection, now: float) -> None:
        pace = self._progress.setdefault(connection, _Progress(now))
        strain = self._read_state(connection.transport)
        if strain is None:
            return
        if pace.acked < 0 and strain.retransmissions >= LOSSY_RETRANSMISSIONS:
            self._redundant_until = now + REDUNDANCY_S
        if strain.acked != pace.acked or not strain.unacked:
            pace.moved_at, pace.acked, pace.retransmissions = now, strain.acked, strain.retransmissions
        pace.unacked = strain.unacked
        pace.is_retransmitting = strain.retransmissions > pace.retransmissions
        if self._is_stalled(pace, now):
            self._redundant_until = now + REDUNDANCY_S

    def _stalled_s(self, pace: _Progress, now: float) -> float:
        return now - pace.moved_at if pace.unacked else 0.0

    def _is_stalled(self, pace: _Progress, now: float) -> bool:
        return pace.is_retransmitting and self._stalled_s(pace, now) > STALLED_S

    def _rank(self, pace: _Progress, now: float) -> tuple[bool, float, int]:
        return self._is_stalled(pace, now), self._stalled_s(pace, now), pace.unacked
