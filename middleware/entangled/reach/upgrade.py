"""Upgrade: when a peer to whom others carry is tried directly again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from middleware.entangled.bounded import keep
from middleware.entangled.reach.known import MAX_KNOWN
from middleware.entangled.wire.peer import Peer, Peers

PAUSES = (1.0, 2.0, 5.0, 5.0, 15.0, 60.0)
"""Seconds after which a carried pair tries the direct way again; the last one is repeated.

As many are short as there are orders in which two knock at fresh ports: but one of them may do.
"""
TURN = 0.5
"""Seconds by which one of the two is behind the other, so that only one of them tries."""
GIVEN_UP_S = 60.0
"""Seconds after which a silent carried peer is given up."""


@dataclass(slots=True)
class _Upgrade:
    """A carried peer, and when the direct way is tried next."""

    due: float
    step: int = 0


class Upgrades:
    """The carried peers."""

    def __init__(self, peers: Peers) -> None:
        self._peers = peers
        self._upgrades: dict[bytes, _Upgrade] = {}

    def __len__(self) -> int:
        return len(self._upgrades)

    def add(self, public: bytes, is_behind: bool, now: float) -> None:
        """Try the direct way to a peer from now on; the one of the two who ``is_behind`` leaves it to the other."""
        if public not in self._upgrades:
            keep(self._upgrades, public, _Upgrade(now + PAUSES[0] + (TURN if is_behind else 0.0)), MAX_KNOWN)

    def drop(self, public: bytes) -> None:
        """Try no more: nobody carries to that peer."""
        self._upgrades.pop(public, None)

    def put_off(self, public: bytes, now: float) -> None:
        """Leave it to the peer for once, which is at it."""
        upgrade = self._upgrades.get(public)
        if upgrade is not None:
            upgrade.due = max(upgrade.due, now + _pause(upgrade.step) + TURN)

    def hurry(self, now: float) -> None:
        """Try all of them at once, and often at first, as if they were new."""
        for upgrade in self._upgrades.values():
            upgrade.due, upgrade.step = now, 0

    def due(self, now: float) -> Iterator[tuple[Peer, int]]:
        """The peers whose turn it is, and how often each was tried before; the silent ones are given up."""
        for public, upgrade in list(self._upgrades.items()):
            peer = self._peers.known(public)
            if peer is None or peer.session is None or now - peer.session.heard_at > GIVEN_UP_S:
                del self._upgrades[public]
            elif now >= upgrade.due:
                yield peer, upgrade.step
                upgrade.step += 1
                upgrade.due = now + _pause(upgrade.step)


def _pause(step: int) -> float:
    return PAUSES[min(step, len(PAUSES) - 1)]
