"""Remember a bounded number of recent rejections for diagnostics, with their direction and reason."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from middleware.entangled.bounded import put_bounded

MAX_REJECTIONS = 64
"""The number of rejections that are remembered; the oldest one is deleted first."""
HOUR_S = 3600.0

Side = Literal["they", "we", "call", "code"]
SIDES: tuple[Side, ...] = ("they", "we", "call", "code")


@dataclass(frozen=True)
class Rejection:
    """One rejection and the number of its occurrences; times are seconds of the node's clock.

    ``who`` is the public key of the other node, empty if it sent none.  ``side`` is the direction: ``they`` (the other
    node rejects this node), ``we`` (this node rejects the other node), ``call`` (this node rejects a call of the other
    node), or ``code`` (a newcomer has used an invalid join code).  ``reason`` is for operators: the cause, and after a
    semicolon the remedy.
    """

    who: bytes
    address: str
    side: Side
    code: str
    reason: str
    first_at: float
    last_at: float
    count: int = 1


class Rejections:
    """The rejections of one node, merged by key, side and code."""

    def __init__(self) -> None:
        self._known: dict[tuple[bytes, Side, str], Rejection] = {}

    def __len__(self) -> int:
        return len(self._known)

    def record(self, public: bytes, address: str, side: Side, code: str, reason: str, now: float) -> None:
        """Record a rejection."""
        known = self._known.get((public, side, code), None)
        if known is None or now - known.last_at > HOUR_S:
            rejection = Rejection(public, address, side, code, reason, now, now)
        else:
            rejection = replace(known, address=address, last_at=now, count=known.count + 1)
        put_bounded(self._known, (public, side, code), rejection, MAX_REJECTIONS)

    def list_recent(self, now: float, span: float = HOUR_S) -> list[Rejection]:
        """Return the rejections of the last ``span`` seconds, the newest first."""
        return [each for each in reversed(self._known.values()) if now - each.last_at <= span]
