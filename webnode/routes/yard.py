"""Routes of the yard: where the target lies."""

from __future__ import annotations

from typing import Any

from webnode.errors import Refusal
from webnode.route import API, Ask, Field, Route


def move_target(ask: Ask) -> Any:
    """Put it at a place in the yard."""
    x, y, yard = ask.given["x"], ask.given["y"], ask.board.desk.yard()
    if yard is None:
        raise Refusal("target", "this node has no yard", "start one, or name it in the settings", 409)
    width, height = yard["walls"]
    if not (0.0 <= x <= width and 0.0 <= y <= height):
        raise Refusal("target", f"({x:g}, {y:g}) is outside the yard", f"give x in 0..{width:g} and y in 0..{height:g}")
    return _then(ask.board.desk.move_target(x, y), {"x": x, "y": y})


def clear_target(ask: Ask) -> Any:
    """Take it away."""
    return _then(ask.board.desk.clear_target(), {})


def _then(done: Any, answer: dict[str, Any]) -> Any:
    """``answer``, once the yard has done what was asked, where that takes a while."""
    return answer if done is None else done.addCallback(lambda _: answer)


ROUTES = (
    Route(
        "POST",
        f"{API}/target",
        "Put the target at a place",
        "operator",
        move_target,
        (
            Field("x", "number", "from the yard's lower left corner", unit="m"),
            Field("y", "number", "from the yard's lower left corner", unit="m"),
        ),
        gives="x, y",
        status=202,
    ),
    Route("DELETE", f"{API}/target", "Take the target away", "operator", clear_target, status=202),
)
