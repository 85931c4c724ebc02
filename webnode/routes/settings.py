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
    Field("description", "text", "a one-line description of the device", minimum=0, maximum=200, default=None),
    Field("presence_lease", "number", "time after which other nodes remove a silent device", default=None, unit="s"),
    Field("capabilities", "table", "capabilities in addition to those of its driver", default=None),
    Field("camera_fps", "number", "frame rate of its camera", default=None, unit="per second"),
)


def read_settings(control: TeamControl, uuid: str) -> Deferred[list[Row]]:
    """Read the settings of a device that can change at runtime."""
    return control.call(uuid, SETTINGS_METHOD).addCallback(_make_rows)


def change_settings(control: TeamControl, uuid: str, changes: Mapping[str, Json]) -> Deferred[list[Row]]:
    """Change all of ``changes`` or none; fails with ``Refusal`` 400 for a setting, 409 and 504 for the device."""
    return control.call(uuid, TUNE_METHOD, dict(changes), refused=_make_refusal).addCallback(_make_rows)


def _handle_read(request: RouteRequest) -> Any:
    return read_settings(request.services.control, find_device(request)["uuid"])


def _handle_change(request: RouteRequest) -> Any:
    uuid = find_device(request)["uuid"]
    changes = {
        field.name: request.values[field.name] for field in SETTING_FIELDS if request.values[field.name] is not None
    }
    if not changes:
        raise Refusal("body", "no setting given", f"send some of {', '.join(field.name for field in SETTING_FIELDS)}")
    return change_settings(request.services.control, uuid, changes)


def _make_rows(answer: object) -> list[Row]:
    rows = answer if isinstance(answer, list) else []
    return [_make_row(*row) for row in rows if isinstance(row, list) and len(row) == 6 and clean_text(row[0])]


def _make_row(key: object, value: object, description: object, unit: object, minimum: object, maximum: object) -> Row:
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
        "about": clean_text(description),
        "unit": clean_text(unit, limit=20),
        "least": None if minimum is None else clean_number(minimum),
        "most": None if maximum is None else clean_number(maximum),
        "choices": [],
    }


def _make_refusal(refused: Refused) -> Refusal | None:
    """Return the error of a setting as the device reports it; None for any other refusal."""
    key, _, text = str(refused).partition(": ")
    problem, _, remedy = text.rpartition("; ")
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
        "Change some settings of a device, which validates all values before it changes any",
        "operator",
        _handle_change,
        (DEVICE, *SETTING_FIELDS),
        RESPONSE,
    ),
)
