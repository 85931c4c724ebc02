"""Report: what one body has to tell the others of itself, and when it is worth telling; pure but for the clock."""

from __future__ import annotations

import math
from typing import Any

from twisted.internet.interfaces import IReactorTime

from agents.behaviour import Behaviour
from middleware.tasks import Member, is_bid

FARTHER, NEARER, STEP = 1.15, 0.85, 0.05
"""A report is renewed when the distance grew by 15 % and 5 cm (the target was moved), or shrank so much while the body
does not act."""
TURNED = math.radians(15.0)
"""The direction from the target is told again when it changed by so much."""


class Reporter:
    """Looks at a ``behaviour`` and says what is new."""

    def __init__(self, behaviour: Behaviour, clock: IReactorTime) -> None:
        self._behaviour = behaviour
        self._clock = clock
        self._told_at = -math.inf

    def news(self, known: Member, is_acting: bool) -> dict[str, Any] | None:
        """What the others do not know yet beside ``known``; None where that is nothing."""
        cost = self._behaviour.cost
        if not is_bid(cost):
            cost = None  # what is no cost is no bid, whatever a behaviour says
        news: dict[str, Any] = {}
        if _is_news(cost, known.cost, is_acting):
            news["cost"] = cost
            news["available"] = True
        valid_for = _number(getattr(self._behaviour, "valid_for", 0.0)) or 0.0
        if valid_for != known.valid_for:
            news["valid_for"] = valid_for
        angle = _number(getattr(self._behaviour, "angle", None))
        if angle is not None and cost is not None and (known.angle is None or _apart(angle, known.angle) > TURNED):
            news["angle"] = round(angle, 3)
        now = self._clock.seconds()
        if not news and cost is not None and 0.0 < valid_for < 2.0 * (now - self._told_at):
            news["valid_for"] = valid_for  # said again before it is void
        if news:
            self._told_at = now
        return news or None


def _is_news(cost: float | None, known: float | None, is_acting: bool) -> bool:
    if cost is None or known is None:
        return (cost is None) != (known is None)
    return cost > known * FARTHER + STEP or (not is_acting and cost < known * NEARER - STEP)


def _apart(one: float, other: float) -> float:
    return abs(math.remainder(one - other, math.tau))


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None
