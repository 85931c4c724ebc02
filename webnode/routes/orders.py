"""Routes of orders to devices: messages, and leaving the network for a while."""

from __future__ import annotations

from webnode.field import Json
from webnode.route import API, Ask, Field, Route, device

MAX_MESSAGE = 140
MIN_AWAY_S, MAX_AWAY_S = 0.1, 600.0
AWAY_S = 15.0
UUID = Field("uuid", "text", "the device", "path", most=64)
TEXT = Field("text", "text", "what it is told", most=MAX_MESSAGE)


def announce(ask: Ask) -> Json:
    """Tell all of them."""
    ask.board.desk.message("", ask.given["text"])
    return {}


def message(ask: Ask) -> Json:
    """Tell one."""
    uuid = device(ask)["uuid"]
    ask.board.desk.message(uuid, ask.given["text"])
    return {"id": uuid}


def disconnect(ask: Ask) -> Json:
    """Take one off the network."""
    uuid, seconds = device(ask)["uuid"], ask.given["seconds"]
    ask.board.desk.disconnect(uuid, seconds)
    return {"id": uuid, "seconds": seconds}


ROUTES = (
    Route("POST", f"{API}/message", "A message to all devices", "operator", announce, (TEXT,), status=202),
    Route(
        "POST",
        f"{API}/devices/{{uuid}}/message",
        "A message to one device",
        "operator",
        message,
        (UUID, TEXT),
        gives="id",
        status=202,
    ),
    Route(
        "POST",
        f"{API}/devices/{{uuid}}/disconnect",
        "The device leaves the network and comes back",
        "operator",
        disconnect,
        (
            UUID,
            Field(
                "seconds",
                "number",
                "how long",
                least=MIN_AWAY_S,
                most=MAX_AWAY_S,
                default=AWAY_S,
                is_required=False,
                unit="s",
            ),
        ),
        gives="id, seconds",
        status=202,
    ),
)
