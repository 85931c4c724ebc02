"""Schedule the attempts to replace relayed paths by direct paths."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from middleware.entangled.bounded import put_bounded
from middleware.entangled.nat.known_peers import MAX_KNOWN
from middleware.entangled.wire.peer import Peer, Peers

RETRY_INTERVALS_S = (1.0, 2.0, 5.0, 5.0, 15.0, 60.0)
"""The seconds between attempts of a relayed pair to connect directly; the last interval is repeated.

There is one short interval for each order of sending from additional ports, because possibly only one of the orders
succeeds.
"""
TURN_DELAY_S = 0.5
"""The seconds by which one of the two peers delays its attempt, so that normally only the other peer tries."""
SILENCE_LIMIT_S = 60.0
"""The silence in seconds after which the attempts to a relayed peer end."""


@dataclass(slots=True)
class _Upgrade:
    """A relayed peer, and the time of the next direct attempt."""

    due_at: float
    step: int = 0


class PathUpgrades:
    """The relayed peers and the schedule of their direct attempts."""

    def __init__(self, peers: Peers) -> None:
        self._peers = peers
        self._upgrades: dict[bytes, _Upgrade] = {}

    def __len__(self) -> int:
        return len(self._upgrades)

    def add(self, public: bytes, is_behind: bool, now: float) -> None:
        """Schedule direct attempts to a peer; with ``is_behind``, this node tries later than the peer."""
        if public not in self._upgrades:
            put_bounded(
                self._upgrades,
                public,
                _Upgrade(now + RETRY_INTERVALS_S[0] + (TURN_DELAY_S if is_behind else 0.0)),
                MAX_KNOWN,
            )

    def drop(self, public: bytes) -> None:
        """Stop the attempts to a peer."""
        self._upgrades.pop(public, None)

    def delay(self, public: bytes, now: float) -> None:
        """Delay the next attempt, because the peer is trying."""
        upgrade = self._upgrades.get(public)
        if upgrade is not None:
            upgrade.due_at = max(upgrade.due_at, now + _interval(upgrade.step) + TURN_DELAY_S)

    def retry_now(self, now: float) -> None:
        """Try all peers immediately, and restart the schedule."""
        for upgrade in self._upgrades.values():
            upgrade.due_at, upgrade.step = now, 0

    def due(self, now: float) -> Iterator[tuple[Peer, int]]:
        """Yield each peer whose attempt is due and the number of its earlier attempts; drop silent peers."""
        for public, upgrade in list(self._upgrades.items()):
            peer = self._peers.get(public)
            if peer is None or peer.session is None or now - peer.session.last_received_at > SILENCE_LIMIT_S:
                del self._upgrades[public]
            elif now >= upgrade.due_at:
                yield peer, upgrade.step
                upgrade.step += 1
                upgrade.due_at = now + _interval(upgrade.step)


def _interval(step: int) -> float:
    return RETRY_INTERVALS_S[min(step, len(RETRY_INTERVALS_S) - 1)]
