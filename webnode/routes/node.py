"""Routes of the node itself: everything that it knows, and its streams."""

from __future__ import annotations

from webnode.field import Json
from webnode.route import API, Ask, Field, Route


def state(ask: Ask) -> Json:
    """Everything that the page shows."""
    return ask.state


UUID = Field("uuid", "text", "the device", "path", most=64)
ROUTES = (
    Route(
        "GET", f"{API}/state", "Everything that the page shows", "viewer", state, gives="node, devices, tasks, groups"
    ),
    Route("GET", "/events", "The state and its changes as server-sent events", "viewer", None),
    Route(
        "GET",
        "/shot/{uuid}",
        "The newest picture of a camera, as soon as there is a newer one; 204 after five seconds without",
        "viewer",
        None,
        (
            UUID,
            Field(
                "after", "text", "number of the last picture (X-Seq)", "query", least=0, is_required=False, default=""
            ),
            Field("viewer", "text", "name of who looks", "query", least=0, most=40, is_required=False, default=""),
        ),
        gives="image/jpeg",
    ),
    Route("GET", "/static/{file}", "A file of the page", "anyone", None, (Field("file", "text", "its name", "path"),)),
)
