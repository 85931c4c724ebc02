"""Parties: the auctions in which one node has a part, no more than it has room for; pure.

Where it is full, the peer that opened the most makes room: whoever invents auctions drives out its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from middleware.consensus.bidding.party import Party

MAX_PARTIES = 256
LIFE_S = 300.0
"""Seconds after which a party in which nothing happens is forgotten, unless it is this node's own."""
OWN = b""


@dataclass
class _Held:
    party: Party
    opener: bytes
    touched_at: float


class Parties:
    """Parties by the digest of their auction; those that this node entered itself are never driven out."""

    def __init__(self) -> None:
        self._held: dict[bytes, _Held] = {}

    def __len__(self) -> int:
        return len(self._held)

    def __iter__(self) -> Iterator[Party]:
        return iter([held.party for held in self._held.values()])

    def get(self, digest: bytes) -> Party | None:
        """The party in the auction with this digest."""
        held = self._held.get(digest)
        return held.party if held is not None else None

    def touch(self, digest: bytes, now: float) -> None:
        """Take note that something happened in a party."""
        held = self._held.get(digest)
        if held is not None:
            held.touched_at = now

    def add(self, party: Party, opener: bytes, now: float) -> list[Party]:
        """Keep ``party``, which ``opener`` (a node id, or ``OWN``) asked for; those that had to go for it."""
        idle = [d for d, held in self._held.items() if held.opener != OWN and held.touched_at < now - LIFE_S]
        gone = [self._held.pop(digest).party for digest in idle]
        while len(self._held) >= MAX_PARTIES:
            counts = Counter(held.opener for held in self._held.values() if held.opener != OWN)
            if not counts:
                break
            busiest = counts.most_common(1)[0][0]
            digest = next(digest for digest, held in self._held.items() if held.opener == busiest)
            gone.append(self._held.pop(digest).party)
        self._held[party.auction.digest] = _Held(party, opener, now)
        return gone

    def own(self, digest: bytes, is_own: bool, opener: bytes = b"left") -> None:
        """Let a party be this node's own, or no longer."""
        held = self._held.get(digest)
        if held is not None:
            held.opener = OWN if is_own else opener
