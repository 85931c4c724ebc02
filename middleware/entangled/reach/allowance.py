"""Allowance: how often a peer may have this node introduce it, and make it knock at others."""

from __future__ import annotations

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.reach.known import keep
from middleware.entangled.token_bucket import TokenBucket

INTRODUCTIONS = 20.0
"""Times in a second, and at once twice as often, that one peer may have this node introduce it."""
MEETS, MEETS_AT_ONCE = 1.0, 60.0
"""Times in a second, and at once, that one peer may make this node knock where nobody answers.  Who is met does not
count; so a member that names addresses of strangers gets 0.2 MB/s sent there by this node, and a team that starts
behind routers none the less meets in a moment."""


class Allowance:
    """What is left to each peer, and who introduced whom."""

    def __init__(self, clock: IReactorTime) -> None:
        self._clock = clock
        self._buckets: dict[tuple[str, bytes], TokenBucket] = {}
        self._introducers: dict[bytes, bytes] = {}

    def __len__(self) -> int:
        return len(self._buckets)

    def may_introduce(self, asker: bytes) -> bool:
        """Whether that peer may have this node introduce it once more; then this is counted."""
        return self._may("introduce", asker, INTRODUCTIONS, 2 * INTRODUCTIONS)

    def may_meet(self, introducer: bytes) -> bool:
        """Whether that peer may make this node knock once more; then this is counted."""
        return self._may("meet", introducer, MEETS, MEETS_AT_ONCE)

    def introduced(self, public: bytes, introducer: bytes) -> None:
        """Take note of who makes this node knock at a peer."""
        keep(self._introducers, public, introducer)

    def met(self, public: bytes) -> None:
        """Give back to who introduced a peer what this cost: it has answered."""
        bucket = self._buckets.get(("meet", self._introducers.pop(public, b"")))
        if bucket is not None:
            bucket.give()

    def _may(self, what: str, public: bytes, rate: float, at_once: float) -> bool:
        key = (what, public)
        bucket = self._buckets.pop(key, None) or TokenBucket(rate, at_once)
        keep(self._buckets, key, bucket)
        return bucket.take(self._clock.seconds())
