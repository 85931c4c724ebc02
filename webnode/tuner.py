"""Tuner: the settings of devices that can be changed while they run; each device checks its own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from twisted.internet.defer import Deferred

from middleware.config.tuning import SETTINGS, TUNE, WRONG
from middleware.entangled.errors import Refused
from webnode.board import Knob, Tuning
from webnode.errors import Refusal
from webnode.field import Json, number, properties, text
from webnode.ground import Ground
from webnode.team import TeamDesk


def tuning(ground: Ground) -> Tuning | None:
    """The tuner of this node."""
    return TeamTuning(ground.desk)


class TeamTuning:
    """Asks the devices that ``desk`` knows."""

    def __init__(self, desk: TeamDesk) -> None:
        self._desk = desk

    def settings(self, uuid: str) -> Deferred[list[Knob]]:
        """What can be changed."""
        return self._desk.call(uuid, SETTINGS).addCallback(_knobs)

    def change(self, uuid: str, changes: Mapping[str, Json]) -> Deferred[list[Knob]]:
        """Change some, all or none; the device checks them."""
        return self._desk.call(uuid, TUNE, dict(changes), refused=_refusal).addCallback(_knobs)


def _knobs(answer: object) -> list[Knob]:
    rows = answer if isinstance(answer, list) else []
    return [knob for row in rows if (knob := _knob(row)) is not None]


def _knob(row: Any) -> Knob | None:
    if not isinstance(row, list) or len(row) != 6 or not text(row[0]):
        return None
    key, value, about, unit, least, most = row
    lawful: Any = (
        properties(value) if isinstance(value, dict) else text(value) if isinstance(value, str) else number(value)
    )
    lowest, highest = (None if bound is None else number(bound) for bound in (least, most))
    return Knob(text(key, limit=64), lawful, text(about), text(unit, limit=20), lowest, highest)


def _refusal(refused: Refused) -> Refusal | None:
    """What a device says is wrong with a setting; None where it says no to something else."""
    key, _, words = str(refused).partition(": ")
    problem, _, remedy = words.rpartition("; ")
    return Refusal(text(key), text(problem), text(remedy)) if refused.code == WRONG and problem else None
