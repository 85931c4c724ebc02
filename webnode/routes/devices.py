"""Routes of the devices: who is here."""

from __future__ import annotations

from webnode.field import Json
from webnode.route import API, Ask, Route


def devices(ask: Ask) -> Json:
    """All of them."""
    listed: Json = ask.state["devices"]
    return listed


ROUTES = (
    Route(
        "GET", f"{API}/devices", "The devices, in the order of joining", "viewer", devices, gives="a list of devices"
    ),
)
