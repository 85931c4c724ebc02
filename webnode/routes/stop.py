"""Routes of the stop of the whole team."""

from __future__ import annotations

from typing import Any

from middleware.stop.stop_set import MAX_RELEASED
from middleware.stop.stop_state import NO_ROBOT, STANDS_STILL
from webnode.errors import Refusal
from webnode.route import API, Field, Route, RouteRequest
from webnode.sanitize import Json
from webnode.stop_control import StopControl


def read_halted(request: RouteRequest) -> Json:
    """Return whether every robot stands still."""
    _require_stop_control(request)
    return {"halted": bool(request.state.get("halted"))}


def stop_team(request: RouteRequest) -> Any:
    """Stop every robot of the team."""
    return _require_stop_control(request).stop(_get_name(request)).addCallback(_summarize, True)


def release_team(request: RouteRequest) -> Any:
    """End the given stops, by default all known stops."""
    return (
        _require_stop_control(request)
        .release(_get_name(request), request.values.get("stops"))
        .addCallback(_summarize, False)
    )


def _summarize(devices: dict[str, str], otherwise: bool) -> Any:
    """Summarize the confirmations; ``otherwise`` is whether a team without robots is reported as stopped."""
    robots = [each for each in devices.values() if each != NO_ROBOT]
    return {"halted": all(each == STANDS_STILL for each in robots) if robots else otherwise, "devices": devices}


def _get_name(request: RouteRequest) -> str:
    return request.user.name or request.user.role


def _require_stop_control(request: RouteRequest) -> StopControl:
    if request.services.stop_control is None:
        raise Refusal("halt", "this node cannot stop the team", "use another web node of the team", 409)
    return request.services.stop_control


RESPONSE = "halted (every robot stands still), devices (state by uuid, as text)"
STOPS = Field(
    "stops",
    "list",
    "The ids of the stops to end, as in `halt` of the state; all known stops if omitted",
    maximum=MAX_RELEASED,
    default=None,
)
ROUTES = (
    Route(
        "GET",
        f"{API}/halt",
        "Whether the team is stopped and every robot stands still",
        "viewer",
        read_halted,
        response="halted",
    ),
    Route(
        "POST",
        f"{API}/halt",
        "Stop every robot of the team until a release; answered when all have confirmed or after a timeout",
        "operator",
        stop_team,
        response=RESPONSE,
    ),
    Route("DELETE", f"{API}/halt", "Release the team; tasks continue", "operator", release_team, (STOPS,), RESPONSE),
)
