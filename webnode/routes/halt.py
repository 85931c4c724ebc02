"""Routes of the halt of the whole team."""

from __future__ import annotations

from typing import Any

from middleware.stop.halt import NO_ROBOT, STANDS
from middleware.stop.stop_set import MAX_RELEASED
from webnode.errors import Refusal
from webnode.field import Json
from webnode.halting import TeamHalts
from webnode.route import API, Ask, Field, Route


def is_halted(ask: Ask) -> Json:
    """Whether all of it stands."""
    _halts(ask)
    return {"halted": bool(ask.state.get("halted"))}


def halt(ask: Ask) -> Any:
    """Stop all of it."""
    return _halts(ask).halt(_name(ask)).addCallback(_told, True)


def release(ask: Ask) -> Any:
    """End the stops that are named, or all that are known."""
    return _halts(ask).release(_name(ask), ask.given.get("stops")).addCallback(_told, False)


def _told(devices: dict[str, str], otherwise: bool) -> Any:
    """What each device does; ``otherwise``: whether a team without robots counts as stopped."""
    robots = [said for said in devices.values() if said != NO_ROBOT]
    return {"halted": all(said == STANDS for said in robots) if robots else otherwise, "devices": devices}


def _name(ask: Ask) -> str:
    return ask.who.name or ask.who.role


def _halts(ask: Ask) -> TeamHalts:
    if ask.board.halts is None:
        raise Refusal("halt", "this node cannot stop the team", "ask another web node of the team", 409)
    return ask.board.halts


GIVES = "halted (every robot stands), devices (uuid to what it does, in words)"
STOPS = Field(
    "stops",
    "list",
    "The ids of the stops to end, as in `halt` of the state; all that are known where it is left out",
    most=MAX_RELEASED,
    default=None,
)
ROUTES = (
    Route(
        "GET", f"{API}/halt", "Whether the team is stopped and every robot stands", "viewer", is_halted, gives="halted"
    ),
    Route(
        "POST",
        f"{API}/halt",
        "Stop: every robot of the team stands at once, and stays so; answered when all have said so, or have not",
        "operator",
        halt,
        gives=GIVES,
    ),
    Route("DELETE", f"{API}/halt", "Let the team go on from where it was", "operator", release, (STOPS,), GIVES),
)
