"""Routes of the halt of the whole team."""

from __future__ import annotations

from typing import Any

from webnode.board import Halts
from webnode.errors import Refusal
from webnode.field import Json
from webnode.route import API, Ask, Route


def is_halted(ask: Ask) -> Json:
    """Whether it is halted."""
    return {"halted": _halts(ask).is_halted()}


def halt(ask: Ask) -> Any:
    """Stop all of it."""
    return _halts(ask).halt(_name(ask)).addCallback(lambda devices: {"halted": True, "devices": devices})


def release(ask: Ask) -> Any:
    """Let it go on."""
    return _halts(ask).release(_name(ask)).addCallback(lambda devices: {"halted": False, "devices": devices})


def _name(ask: Ask) -> str:
    return ask.who.name or ask.who.role


def _halts(ask: Ask) -> Halts:
    if ask.board.halts is None:
        raise Refusal("halt", "this node cannot stop the team", "ask another web node of the team", 409)
    return ask.board.halts


GIVES = "halted, devices (uuid to what it does, in words)"
ROUTES = (
    Route("GET", f"{API}/halt", "Whether the team is stopped", "viewer", is_halted, gives="halted"),
    Route(
        "POST",
        f"{API}/halt",
        "Stop: every robot of the team stands at once, and stays so; answered when all have said so, or have not",
        "operator",
        halt,
        gives=GIVES,
    ),
    Route("DELETE", f"{API}/halt", "Let the team go on from where it was", "operator", release, gives=GIVES),
)
