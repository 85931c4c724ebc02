"""Routes of the stop of the whole team."""

from __future__ import annotations

from typing import Any

from middleware.stop.halt import NO_ROBOT, STANDS
from middleware.stop.stop_set import MAX_RELEASED
from webnode.errors import Refusal
from webnode.field import Json
from webnode.halting import TeamHalts
from webnode.route import API, Ask, Field, Route


def is_halted(ask: Ask) -> Json:
    """Return whether every robot stands still."""
    _halts(ask)
    return {"halted": bool(ask.state.get("halted"))}


def halt(ask: Ask) -> Any:
    """Stop every robot of the team."""
    return _halts(ask).halt(_name(ask)).addCallback(_summarize, True)


def release(ask: Ask) -> Any:
    """End the given stops, or all known ones."""
    return _halts(ask).release(_name(ask), ask.given.get("stops")).addCallback(_summarize, False)


def _summarize(devices: dict[str, str], otherwise: bool) -> Any:
    """Summarize the confirmations; ``otherwise``: whether a team without robots counts as stopped."""
    robots = [each for each in devices.values() if each != NO_ROBOT]
    return {"halted": all(each == STANDS for each in robots) if robots else otherwise, "devices": devices}


def _name(ask: Ask) -> str:
    return ask.who.name or ask.who.role


def _halts(ask: Ask) -> TeamHalts:
    if ask.board.halts is None:
        raise Refusal("halt", "this node cannot stop the team", "use another web node of the team", 409)
    return ask.board.halts


GIVES = "halted (every robot stands still), devices (state by uuid, as text)"
STOPS = Field(
    "stops",
    "list",
    "The ids of the stops to end, as in `halt` of the state; all known ones if it is left out",
    most=MAX_RELEASED,
    default=None,
)
ROUTES = (
    Route(
        "GET",
        f"{API}/halt",
        "Whether the team is stopped and every robot stands still",
        "viewer",
        is_halted,
        gives="halted",
    ),
    Route(
        "POST",
        f"{API}/halt",
        "Stop every robot of the team until a release; answered when all have confirmed or after a timeout",
        "operator",
        halt,
        gives=GIVES,
    ),
    Route("DELETE", f"{API}/halt", "Release the team; tasks continue", "operator", release, (STOPS,), GIVES),
)
