"""Routes of the devices: list, messages, and leaving the network for some time."""

from __future__ import annotations

from typing import Any

from webnode.route import API, DEVICE, Field, Route, RouteRequest, find_device
from webnode.sanitize import Json

MAX_MESSAGE = 140
MIN_AWAY_S, MAX_AWAY_S = 0.1, 600.0
AWAY_S = 15.0
TEXT = Field("text", "text", "the message", maximum=MAX_MESSAGE)


def list_devices(request: RouteRequest) -> Json:
    """Return all devices."""
    listed: Json = request.state["devices"]
    return listed


def send_to_all(request: RouteRequest) -> Any:
    """Send a message to all devices."""
    return request.services.control.send_message("", request.values["text"])


def send_message(request: RouteRequest) -> Any:
    """Send a message to one device."""
    uuid = find_device(request)["uuid"]
    return request.services.control.send_message(uuid, request.values["text"]).addCallback(
        lambda answer: {"id": uuid, **answer}
    )


def disconnect(request: RouteRequest) -> Any:
    """Let a device leave the network for some time."""
    uuid, seconds = find_device(request)["uuid"], request.values["seconds"]

    def left(_: object) -> Json:
        request.services.event_log.record_fault(uuid, "disconnect", request.now)
        return {"id": uuid, "seconds": seconds}

    return request.services.control.disconnect(uuid, seconds).addCallback(left)


RESPONSE = "delivered (names), failed (reason by name)"
ROUTES = (
    Route(
        "GET",
        f"{API}/devices",
        "The devices, in the order of joining",
        "viewer",
        list_devices,
        response="a list of devices",
    ),
    Route("POST", f"{API}/message", "A message to all devices", "operator", send_to_all, (TEXT,), RESPONSE, 202),
    Route(
        "POST",
        f"{API}/devices/{{uuid}}/message",
        "A message to one device",
        "operator",
        send_message,
        (DEVICE, TEXT),
        response=f"id, {RESPONSE}",
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
                minimum=MIN_AWAY_S,
                maximum=MAX_AWAY_S,
                default=AWAY_S,
                unit="s",
            ),
        ),
        response="id, seconds",
        status=202,
    ),
)
