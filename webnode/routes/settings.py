"""Routes of the settings of devices that can be changed while they run."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from webnode.board import Knob, Tuning
from webnode.errors import Refusal
from webnode.field import Json
from webnode.route import API, Ask, Field, Route, device

UUID = Field("uuid", "text", "the device", "path", most=64)
KNOBS = (
    Field("description", "text", "a line about the device", least=0, most=200, is_required=False),
    Field("presence_lease", "number", "how long the others believe in it without a sign", is_required=False, unit="s"),
    Field("capabilities", "table", "what it can do beyond what its driver says", is_required=False),
    Field("camera_fps", "number", "pictures that its camera takes", is_required=False, unit="per second"),
)


def settings(ask: Ask) -> Any:
    """What can be changed."""
    return _tuning(ask).settings(device(ask)["uuid"]).addCallback(_rows)


def change(ask: Ask) -> Any:
    """Change some of it."""
    uuid = device(ask)["uuid"]
    changes = {knob.name: ask.given[knob.name] for knob in KNOBS if ask.given[knob.name] is not None}
    if not changes:
        raise Refusal("body", "it names no setting", f"give some of {', '.join(knob.name for knob in KNOBS)}")
    return _tuning(ask).change(uuid, changes).addCallback(_rows)


def _tuning(ask: Ask) -> Tuning:
    if ask.board.tuning is None:
        raise Refusal("settings", "this node cannot change them", "ask another web node of the team", 409)
    return ask.board.tuning


def _rows(knobs: list[Knob]) -> Json:
    return [asdict(knob) for knob in knobs]


PATH = f"{API}/devices/{{uuid}}/settings"
GIVES = "a list of key, value, about, unit, least, most, choices"
ROUTES = (
    Route("GET", PATH, "The settings of a device that can be changed", "viewer", settings, (UUID,), GIVES),
    Route(
        "PUT", PATH, "Change some of them; the device checks all before any", "operator", change, (UUID, *KNOBS), GIVES
    ),
)
