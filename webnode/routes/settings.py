"""Routes of the settings of devices that can be changed while they run; each device checks its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from twisted.internet.defer import Deferred

from middleware.config.tuning import SETTINGS, TUNE, WRONG
from middleware.entangled.errors import Refused
from webnode.desk import Desk
from webnode.errors import Refusal
from webnode.field import Json, number, properties, text
from webnode.route import API, Ask, Field, Route, device

UUID = Field("uuid", "text", "the device", "path", most=64)
KNOBS = (
    Field("description", "text", "a line about the device", least=0, most=200, is_required=False),
    Field("presence_lease", "number", "how long the others believe in it without a sign", is_required=False, unit="s"),
    Field("capabilities", "table", "what it can do beyond what its driver says", is_required=False),
    Field("camera_fps", "number", "pictures that its camera takes", is_required=False, unit="per second"),
)


@dataclass(frozen=True)
class Knob:
    """A setting of a device that can be changed while it runs."""

    key: str
    value: Json
    about: str
    unit: str = ""
    least: float | None = None
    most: float | None = None
    choices: tuple[str, ...] = ()


def read_settings(desk: Desk, uuid: str) -> Deferred[list[Knob]]:
    """Return the settings of a device that can be changed."""
    return desk.call(uuid, SETTINGS).addCallback(_knobs)


def change_settings(desk: Desk, uuid: str, changes: Mapping[str, Json]) -> Deferred[list[Knob]]:
    """Change all of ``changes`` or none; fails with ``Refusal``: 400 names the setting, 409 and 504 the device."""
    return desk.call(uuid, TUNE, dict(changes), refused=_refusal).addCallback(_knobs)


def _read(ask: Ask) -> Any:
    return read_settings(ask.board.desk, device(ask)["uuid"]).addCallback(_rows)


def _change(ask: Ask) -> Any:
    uuid = device(ask)["uuid"]
    changes = {knob.name: ask.given[knob.name] for knob in KNOBS if ask.given[knob.name] is not None}
    if not changes:
        raise Refusal("body", "it names no setting", f"give some of {', '.join(knob.name for knob in KNOBS)}")
    return change_settings(ask.board.desk, uuid, changes).addCallback(_rows)


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


def _rows(knobs: list[Knob]) -> Json:
    return [asdict(knob) for knob in knobs]


PATH = f"{API}/devices/{{uuid}}/settings"
GIVES = "a list of key, value, about, unit, least, most, choices"
ROUTES = (
    Route("GET", PATH, "The settings of a device that can be changed", "viewer", _read, (UUID,), GIVES),
    Route(
        "PUT",
        PATH,
        "Change some of them; the device checks all before any",
        "operator",
        _change,
        (UUID, *KNOBS),
        GIVES,
    ),
)
