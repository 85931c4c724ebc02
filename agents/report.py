"""Determine the values that one agent reports about its device, and whether they changed enough to be sent; pure."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

from agents.behaviour import Behaviour
from drivers.reading import Observation
from middleware.tasks.task import Member, is_bid, is_choice, is_value, is_weight

INCREASE_FACTOR, DECREASE_FACTOR, COST_STEP_M = 1.15, 0.85, 0.05
"""Change after which a cost is sent again: 15 % and 5 cm; a decrease is not sent while the robot acts."""
ANGLE_STEP_RAD = math.radians(15.0)
"""Change after which the robot's direction, as seen from the target, is sent again."""
BATTERY_STEP = 0.05
"""Change after which the battery charge (0 to 1) is sent again."""
MIN_REPORT_INTERVAL_S = 1.0
"""Minimum seconds between two reports of a changing ``value``; votes and the first ``value`` are sent immediately."""


class ReportBuilder:
    """Determines the changes of a ``behaviour`` that have not been sent to the other agents yet.

    ``reads`` are the fields that the task's strategy reads besides the cost; ``load`` is the number of the agent's
    tasks.
    """

    def __init__(self, behaviour: Behaviour, reads: Collection[str] = ()) -> None:
        self.load = 1
        self._behaviour = behaviour
        self._reads = reads
        self._reported_at = -math.inf
        self._numbers_sent_at = -math.inf

    def find_changes(self, known: Member, is_acting: bool, seen: Observation, now: float) -> dict[str, Any] | None:
        """Return the fields that differ enough from the last report ``known``; None if there are no such fields."""
        cost = self._behaviour.cost
        if not is_bid(cost):
            cost = None  # an invalid cost is not a bid
        news: dict[str, Any] = {}
        if _has_changed(cost, known.cost, is_acting):
            news["cost"] = cost
        if news or not known.available:
            news["available"] = True
        valid_for = _to_number(getattr(self._behaviour, "valid_for", 0.0)) or 0.0
        if valid_for != known.valid_for:
            news["valid_for"] = valid_for
        angle = _to_number(getattr(self._behaviour, "angle", None))
        if (
            angle is not None
            and cost is not None
            and (known.angle is None or _angle_between(angle, known.angle) > ANGLE_STEP_RAD)
        ):
            news["angle"] = round(angle, 3)
        if cost is not None:
            news |= self._find_changed_fields(known, seen, now)
        if not news and cost is not None and 0.0 < valid_for < 2.0 * (now - self._reported_at):
            news["valid_for"] = valid_for  # renewed before it expires
        if news:
            self._reported_at = now
        return news or None

    def _find_changed_fields(self, known: Member, seen: Observation, now: float) -> dict[str, Any]:
        """Return the changed fields that only some strategies read; invalid values are not sent."""
        news: dict[str, Any] = {}
        if "load" in self._reads and self.load != known.load:
            news["load"] = self.load
        charge = _to_number(seen.values.get("power.level"))
        if "battery" in self._reads and charge is not None:
            battery = round(min(1.0, max(0.0, charge)), 2)
            if known.cost is None or abs(battery - known.battery) >= BATTERY_STEP:
                news["battery"] = battery
        choice = getattr(self._behaviour, "choice", "")
        choice = choice if is_choice(choice) else ""
        if "choice" in self._reads and choice != known.choice:
            news["choice"] = choice
        is_due = now - self._numbers_sent_at >= MIN_REPORT_INTERVAL_S
        value = getattr(self._behaviour, "value", ())
        value = tuple(map(float, value)) if isinstance(value, tuple) and is_value(value) else ()
        if "value" in self._reads and value != known.value and (is_due or len(value) != len(known.value)):
            news["value"] = value
        for name, default in (("weight", 1.0), ("electorate", 0.0)):
            number = getattr(self._behaviour, name, default)
            number = float(number) if is_weight(number) else default
            if name in self._reads and number != getattr(known, name) and (is_due or known.cost is None):
                news[name] = number
        if news.keys() & {"value", "weight", "electorate"}:
            self._numbers_sent_at = now
        return news


def _has_changed(cost: float | None, known: float | None, is_acting: bool) -> bool:
    if cost is None or known is None:
        return (cost is None) != (known is None)
    return cost > known * INCREASE_FACTOR + COST_STEP_M or (
        not is_acting and cost < known * DECREASE_FACTOR - COST_STEP_M
    )


def _angle_between(one: float, other: float) -> float:
    return abs(math.remainder(one - other, math.tau))


def _to_number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None
