"""Report: what one body has to tell the others of itself, and when it is worth telling; pure."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

from agents.behaviour import Behaviour
from drivers.reading import Observation
from middleware.tasks.task import Member, is_bid, is_choice, is_value, is_weight

FARTHER, NEARER, STEP = 1.15, 0.85, 0.05
"""A report is renewed when the distance grew by 15 % and 5 cm (the target was moved), or shrank so much while the body
does not act."""
TURNED = math.radians(15.0)
"""The direction from the target is told again when it changed by so much."""
DRAINED = 0.05
"""The battery is told again when it changed by so much, as a share."""
PAUSE = 1.0
"""Seconds after which a number that moves is told again; a vote and a first number are told at once."""


class Reporter:
    """Looks at a ``behaviour`` and says what is new; ``reads`` is what the task's strategy goes by beside the cost.

    ``load`` is how many tasks the agent has.
    """

    def __init__(self, behaviour: Behaviour, reads: Collection[str] = ()) -> None:
        self.load = 1
        self._behaviour = behaviour
        self._reads = reads
        self._told_at = -math.inf
        self._moved_at = -math.inf

    def news(self, known: Member, is_acting: bool, seen: Observation, now: float) -> dict[str, Any] | None:
        """What the others do not know yet beside ``known``, as the body senses ``seen``; None where that is nothing."""
        cost = self._behaviour.cost
        if not is_bid(cost):
            cost = None  # what is no cost is no bid, whatever a behaviour says
        news: dict[str, Any] = {}
        if _is_news(cost, known.cost, is_acting):
            news["cost"] = cost
        if news or not known.available:
            news["available"] = True
        valid_for = _number(getattr(self._behaviour, "valid_for", 0.0)) or 0.0
        if valid_for != known.valid_for:
            news["valid_for"] = valid_for
        angle = _number(getattr(self._behaviour, "angle", None))
        if angle is not None and cost is not None and (known.angle is None or _apart(angle, known.angle) > TURNED):
            news["angle"] = round(angle, 3)
        if cost is not None:
            news |= self._offer(known, seen, now)
        if not news and cost is not None and 0.0 < valid_for < 2.0 * (now - self._told_at):
            news["valid_for"] = valid_for  # said again before it is void
        if news:
            self._told_at = now
        return news or None

    def _offer(self, known: Member, seen: Observation, now: float) -> dict[str, Any]:
        """What is new of that by which only some strategies go; what is nothing lawful is not told."""
        news: dict[str, Any] = {}
        if "load" in self._reads and self.load != known.load:
            news["load"] = self.load
        charge = _number(seen.values.get("power.level"))
        if "battery" in self._reads and charge is not None:
            battery = round(min(1.0, max(0.0, charge)), 2)
            if known.cost is None or abs(battery - known.battery) >= DRAINED:
                news["battery"] = battery
        choice = getattr(self._behaviour, "choice", "")
        choice = choice if is_choice(choice) else ""
        if "choice" in self._reads and choice != known.choice:
            news["choice"] = choice
        is_due = now - self._moved_at >= PAUSE
        value = getattr(self._behaviour, "value", ())
        value = tuple(map(float, value)) if isinstance(value, tuple) and is_value(value) else ()
        if "value" in self._reads and value != known.value and (is_due or len(value) != len(known.value)):
            news["value"] = value
        for name, usual in (("weight", 1.0), ("electorate", 0.0)):
            number = getattr(self._behaviour, name, usual)
            number = float(number) if is_weight(number) else usual
            if name in self._reads and number != getattr(known, name) and (is_due or known.cost is None):
                news[name] = number
        if news.keys() & {"value", "weight", "electorate"}:
            self._moved_at = now
        return news


def _is_news(cost: float | None, known: float | None, is_acting: bool) -> bool:
    if cost is None or known is None:
        return (cost is None) != (known is None)
    return cost > known * FARTHER + STEP or (not is_acting and cost < known * NEARER - STEP)


def _apart(one: float, other: float) -> float:
    return abs(math.remainder(one - other, math.tau))


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None
