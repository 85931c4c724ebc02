"""Rebuff: who was not let in lately, by whom and why, for people who look; pure, and bounded."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from middleware.entangled.bounded import keep

MAX_REBUFFS = 64
"""Rebuffs that are remembered; the one that happened longest ago goes first."""
HOUR = 3600.0

Side = Literal["they", "we", "call", "code"]
SIDES: tuple[Side, ...] = ("they", "we", "call", "code")


@dataclass(frozen=True)
class Rebuff:
    """One refusal, however often it happened; moments are seconds of the node's clock.

    ``who`` is the public key of the other one, empty where it showed none.  ``side`` says what happened: ``they`` do
    not let this node in, ``we`` do not let them in, we do not answer their ``call``, or the ``code`` of a newcomer is
    no good.  ``reason`` is for people: why, and after a semicolon what to do.
    """

    who: bytes
    address: str
    side: Side
    code: str
    reason: str
    first_at: float
    last_at: float
    count: int = 1


class Rebuffs:
    """The refusals that one node met; each pair of key and code is one."""

    def __init__(self) -> None:
        self._known: dict[tuple[bytes, Side, str], Rebuff] = {}

    def __len__(self) -> int:
        return len(self._known)

    def met(self, who: bytes, address: str, side: Side, code: str, reason: str, now: float) -> None:
        """Take note of a refusal."""
        known = self._known.get((who, side, code), None)
        if known is None or now - known.last_at > HOUR:
            met = Rebuff(who, address, side, code, reason, now, now)
        else:
            met = replace(known, address=address, last_at=now, count=known.count + 1)
        keep(self._known, (who, side, code), met, MAX_REBUFFS)

    def newest(self, now: float, span: float = HOUR) -> list[Rebuff]:
        """Those of the last ``span`` seconds, the newest first."""
        return [each for each in reversed(self._known.values()) if now - each.last_at <= span]
