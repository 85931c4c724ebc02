"""Routes of the settings of devices that can change at runtime; each device validates its own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from twisted.internet.defer import Deferred

from middleware.config.tuning import INVALID_SETTING, SETTINGS_METHOD, TUNE_METHOD
from middleware.entangled.errors import Refused
from webnode.errors import Refusal
from webnode.route import API, DEVICE, Field, Route, RouteRequest, find_device
from webnode.sanitize import Json, clean_number, clean_properties, clean_text
from webnode.team_control import TeamControl

Row = dict[str, Json]
"""A setting in JSON."""
SETTING_FIELDS = (
    Field("description", "text", "a line about the device", minimum=0, maximum=200, default=None),
    Field("presence_lease", "number", "time until the others drop it if it is silent", default=None, unit="s"),
    Field("capabilities", "table", "capabilities in addition to those of its driver", default=None),
    Field("camera_fps", "number", "pictures of its camera", default=None, unit="per second"),
)


def read_settings(desk: TeamControl, uuid: str) -> Deferred[list[Row]]:
    """Read the settings of a device that can change at runtime."""
    return desk.call(uuid, SETTINGS_METHOD).addCallback(_make_rows)


def change_settings(desk: TeamControl, uuid: str, changes: Mapping[str, Json]) -> Deferred[list[Row]]:
    """Change all of ``changes`` or none; fails with ``Refusal`` 400 for a setting, 409 and 504 for the device."""
    return desk.call(uuid, TUNE_METHOD, dict(changes), refused=_make_refusal).addCallback(_make_rows)


def _handle_read(ask: RouteRequest) -> Any:
    return read_settings(ask.services.control, find_device(ask)["uuid"])


def _handle_change(ask: RouteRequest) -> Any:
    uuid = find_device(ask)["uuid"]
    changes = {knob.name: ask.values[knob.name] for knob in SETTING_FIELDS if ask.values[knob.name] is not None}
    if not changes:
        raise Refusal("body", "no setting given", f"send some of {', '.join(knob.name for knob in SETTING_FIELDS)}")
    return change_settings(ask.services.control, uuid, changes)


def _make_rows(answer: object) -> list[Row]:
    rows = answer if isinstance(answer, list) else []
    return [_make_row(*row) for row in rows if isinstance(row, list) and len(row) == 6 and clean_text(row[0])]


def _make_row(key: object, value: object, about: object, unit: object, least: object, most: object) -> Row:
    valid: Any = (
        clean_properties(value)
        if isinstance(value, dict)
        else clean_text(value)
        if isinstance(value, str)
        else clean_number(value)
    )
    return {
        "key": clean_text(key, limit=64),
        "value": valid,
        "about": clean_text(about),
        "unit": clean_text(unit, limit=20),
        "least": None if least is None else clean_number(least),
        "most": None if most is None else clean_number(most),
        "choices": [],
    }


def _make_refusal(refused: Refused) -> Refusal | None:
    """Return the error of a setting as the device reports it; None for any other refusal."""
    key, _, words = str(refused).partition(": ")
    problem, _, remedy = words.rpartition("; ")
    return (
        Refusal(clean_text(key), clean_text(problem), clean_text(remedy))
        if refused.code == INVALID_SETTING and problem
        else None
    )


PATH = f"{API}/devices/{{uuid}}/settings"
RESPONSE = "a list of key, value, about, unit, least, most, choices"
ROUTES = (
    Route("GET", PATH, "The settings of a device that can be changed", "viewer", _handle_read, (DEVICE,), RESPONSE),
    Route(
        "PUT",
        PATH,
        "Change some of them; the device validates all before it changes any",
        "operator",
        _handle_change,
        (DEVICE, *SETTING_FIELDS),
        RESPONSE,
    ),
)
