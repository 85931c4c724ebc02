"""Routes of the devices: list, messages, and leaving the network for some time."""

from __future__ import annotations

from typing import Any

from webnode.field import Json
from webnode.route import API, DEVICE, Ask, Field, Route, device

MAX_MESSAGE = 140
MIN_AWAY_S, MAX_AWAY_S = 0.1, 600.0
AWAY_S = 15.0
TEXT = Field("text", "text", "the message", most=MAX_MESSAGE)


def devices(ask: Ask) -> Json:
    """Return all devices."""
    listed: Json = ask.state["devices"]
    return listed


def announce(ask: Ask) -> Any:
    """Send a message to all devices."""
    return ask.board.desk.message("", ask.given["text"])


def message(ask: Ask) -> Any:
    """Send a message to one device."""
    uuid = device(ask)["uuid"]
    return ask.board.desk.message(uuid, ask.given["text"]).addCallback(lambda answer: {"id": uuid, **answer})


def disconnect(ask: Ask) -> Any:
    """Let a device leave the network for some time."""
    uuid, seconds = device(ask)["uuid"], ask.given["seconds"]

    def left(_: object) -> Json:
        ask.board.chronicle.faulted(uuid, "disconnect", ask.now)
        return {"id": uuid, "seconds": seconds}

    return ask.board.desk.disconnect(uuid, seconds).addCallback(left)


GIVES = "delivered (names), failed (reason by name)"
ROUTES = (
    Route(
        "GET", f"{API}/devices", "The devices, in the order of joining", "viewer", devices, gives="a list of devices"
    ),
    Route("POST", f"{API}/message", "A message to all devices", "operator", announce, (TEXT,), GIVES, 202),
    Route(
        "POST",
        f"{API}/devices/{{uuid}}/message",
        "A message to one device",
        "operator",
        message,
        (DEVICE, TEXT),
        gives=f"id, {GIVES}",
        status=202,
    ),
    Route(
        "POST",
        f"{API}/devices/{{uuid}}/disconnect",
        "The device leaves the network and returns after the given time",
        "operator",
        disconnect,
        (
            DEVICE,
            Field(
                "seconds",
                "number",
                "duration",
                least=MIN_AWAY_S,
                most=MAX_AWAY_S,
                default=AWAY_S,
                unit="s",
            ),
        ),
        gives="id, seconds",
        status=202,
    ),
)
