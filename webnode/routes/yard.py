"""Routes of the yard: where the target lies."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from webnode.errors import Refusal
from webnode.route import API, Ask, Field, Route

TURN = round(math.tau, 4)


def move_target(ask: Ask) -> Any:
    """Put it at a place in the yard."""
    x, y = ask.given["x"], ask.given["y"]
    _inside(_yard(ask, "target"), "target", x, y)
    return ask.board.desk.move_target(x, y).addCallback(lambda _: {"x": x, "y": y})


def move_robot(ask: Ask) -> Any:
    """Put one at a place in the yard."""
    name, x, y, yard = ask.given["name"], ask.given["x"], ask.given["y"], _yard(ask, "robot")
    found = next((dog for dog in yard["dogs"] if dog["name"] == name), None)
    if found is None:
        here = ", ".join(dog["name"] for dog in yard["dogs"])
        raise Refusal("name", "no robot of the yard is called so", f"choose one of {here}", 404)
    _inside(yard, "robot", x, y)
    heading = found["heading"] if ask.given["heading"] is None else ask.given["heading"]
    moved = {"name": name, "x": x, "y": y, "heading": heading}
    return ask.board.desk.move_robot(name, x, y, heading).addCallback(lambda _: moved)


def clear_target(ask: Ask) -> Any:
    """Take it away."""
    return ask.board.desk.clear_target().addCallback(lambda _: {})


def _yard(ask: Ask, what: str) -> Mapping[str, Any]:
    yard = ask.board.desk.yard()
    if yard is None:
        raise Refusal(what, "this node has no yard", "start one, or name it in the settings", 409)
    return yard


def _inside(yard: Mapping[str, Any], what: str, x: float, y: float) -> None:
    width, height = yard["walls"]
    if not (0.0 <= x <= width and 0.0 <= y <= height):
        raise Refusal(what, f"({x:g}, {y:g}) is outside the yard", f"give x in 0..{width:g} and y in 0..{height:g}")


X = Field("x", "number", "from the yard's lower left corner", unit="m")
Y = Field("y", "number", "from the yard's lower left corner", unit="m")
ROUTES = (
    Route(
        "POST",
        f"{API}/target",
        "Put the target at a place",
        "operator",
        move_target,
        (X, Y),
        gives="x, y",
        status=202,
    ),
    Route("DELETE", f"{API}/target", "Take the target away", "operator", clear_target, status=202),
    Route(
        "PUT",
        f"{API}/yard/robots/{{name}}",
        "Lift a robot of the yard and set it down",
        "operator",
        move_robot,
        (
            Field("name", "text", "its name in the yard", "path", most=64),
            X,
            Y,
            Field(
                "heading",
                "number",
                "where it looks, counter-clockwise from the right; as before where it is left out",
                least=-TURN,
                most=TURN,
                default=None,
                unit="rad",
            ),
        ),
        gives="name, x, y, heading",
        status=202,
    ),
)
