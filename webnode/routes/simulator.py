"""Routes of the robot simulator: move the target and robots."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from webnode.errors import Refusal
from webnode.route import API, Field, Route, RouteRequest

FULL_TURN_RAD = round(math.tau, 4)


def move_target(request: RouteRequest) -> Any:
    """Put the target at a position."""
    x, y = request.values["x"], request.values["y"]
    _require_inside(_require_map(request, "target"), "target", x, y)
    return request.services.control.move_target(x, y).addCallback(lambda _: {"x": x, "y": y})


def move_robot(request: RouteRequest) -> Any:
    """Move a robot to a position."""
    name, x, y, robot_map = (
        request.values["name"],
        request.values["x"],
        request.values["y"],
        _require_map(request, "robot"),
    )
    found = next((dog for dog in robot_map["dogs"] if dog["name"] == name), None)
    if found is None:
        here = ", ".join(dog["name"] for dog in robot_map["dogs"])
        raise Refusal("name", "unknown robot", f"choose one of {here}", 404)
    _require_inside(robot_map, "robot", x, y)
    heading = found["heading"] if request.values["heading"] is None else request.values["heading"]
    moved = {"name": name, "x": x, "y": y, "heading": heading}
    return request.services.control.move_robot(name, x, y, heading).addCallback(lambda _: moved)


def clear_target(request: RouteRequest) -> Any:
    """Remove the target."""
    return request.services.control.clear_target().addCallback(lambda _: {})


def _require_map(request: RouteRequest, what: str) -> Mapping[str, Any]:
    robot_map = request.services.control.get_map()
    if robot_map is None:
        raise Refusal(
            what, "this node has no robot simulator", "start a simulator, and set its address in [web] yard", 409
        )
    return robot_map


def _require_inside(robot_map: Mapping[str, Any], what: str, x: float, y: float) -> None:
    width, height = robot_map["walls"]
    if not (0.0 <= x <= width and 0.0 <= y <= height):
        raise Refusal(what, f"({x:g}, {y:g}) is outside the map", f"send x in 0..{width:g} and y in 0..{height:g}")


X = Field("x", "number", "from the map's lower left corner", unit="m")
Y = Field("y", "number", "from the map's lower left corner", unit="m")
ROUTES = (
    Route(
        "POST",
        f"{API}/target",
        "Put the target at a position",
        "operator",
        move_target,
        (X, Y),
        response="x, y",
        status=202,
    ),
    Route("DELETE", f"{API}/target", "Remove the target", "operator", clear_target, status=202),
    Route(
        "PUT",
        f"{API}/yard/robots/{{name}}",
        "Move a robot of the simulator",
        "operator",
        move_robot,
        (
            Field("name", "text", "name of the robot", "path", maximum=64),
            X,
            Y,
            Field(
                "heading",
                "number",
                "direction, counter-clockwise from the right; unchanged if left out",
                minimum=-FULL_TURN_RAD,
                maximum=FULL_TURN_RAD,
                default=None,
                unit="rad",
            ),
        ),
        response="name, x, y, heading",
        status=202,
    ),
)
