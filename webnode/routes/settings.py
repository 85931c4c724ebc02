"""Routes of the settings of devices that can change at runtime; each device validates its own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from twisted.internet.defer import Deferred

from middleware.config.tuning import SETTINGS, TUNE, WRONG
from middleware.entangled.errors import Refused
from webnode.errors import Refusal
from webnode.field import Json, number, properties, text
from webnode.route import API, DEVICE, Ask, Field, Route, device
from webnode.team import TeamDesk

Row = dict[str, Json]
"""A setting in JSON."""
KNOBS = (
    Field("description", "text", "a line about the device", least=0, most=200, default=None),
    Field("presence_lease", "number", "time until the others drop it if it is silent", default=None, unit="s"),
    Field("capabilities", "table", "capabilities in addition to those of its driver", default=None),
    Field("camera_fps", "number", "pictures of its camera", default=None, unit="per second"),
)


def read_settings(desk: TeamDesk, uuid: str) -> Deferred[list[Row]]:
    """Read the settings of a device that can change at runtime."""
    return desk.call(uuid, SETTINGS).addCallback(_rows)


def change_settings(desk: TeamDesk, uuid: str, changes: Mapping[str, Json]) -> Deferred[list[Row]]:
    """Change all of ``changes`` or none; fails with ``Refusal`` 400 for a setting, 409 and 504 for the device."""
    return desk.call(uuid, TUNE, dict(changes), refused=_refusal).addCallback(_rows)


def _read(ask: Ask) -> Any:
    return read_settings(ask.board.desk, device(ask)["uuid"])


def _change(ask: Ask) -> Any:
    uuid = device(ask)["uuid"]
    changes = {knob.name: ask.given[knob.name] for knob in KNOBS if ask.given[knob.name] is not None}
    if not changes:
        raise Refusal("body", "no setting given", f"send some of {', '.join(knob.name for knob in KNOBS)}")
    return change_settings(ask.board.desk, uuid, changes)


def _rows(answer: object) -> list[Row]:
    rows = answer if isinstance(answer, list) else []
    return [_row(*row) for row in rows if isinstance(row, list) and len(row) == 6 and text(row[0])]


def _row(key: object, value: object, about: object, unit: object, least: object, most: object) -> Row:
    valid: Any = (
        properties(value) if isinstance(value, dict) else text(value) if isinstance(value, str) else number(value)
    )
    return {
        "key": text(key, limit=64),
        "value": valid,
        "about": text(about),
        "unit": text(unit, limit=20),
        "least": None if least is None else number(least),
        "most": None if most is None else number(most),
        "choices": [],
    }


def _refusal(refused: Refused) -> Refusal | None:
    """Return the error of a setting as the device reports it; None for any other refusal."""
    key, _, words = str(refused).partition(": ")
    problem, _, remedy = words.rpartition("; ")
    return Refusal(text(key), text(problem), text(remedy)) if refused.code == WRONG and problem else None


PATH = f"{API}/devices/{{uuid}}/settings"
GIVES = "a list of key, value, about, unit, least, most, choices"
ROUTES = (
    Route("GET", PATH, "The settings of a device that can be changed", "viewer", _read, (DEVICE,), GIVES),
    Route(
        "PUT",
        PATH,
        "Change some of them; the device validates all before it changes any",
        "operator",
        _change,
        (DEVICE, *KNOBS),
        GIVES,
    ),
)
