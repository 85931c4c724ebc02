"""Routes of the event log of the team and of this node's audit log."""

from __future__ import annotations

from dataclasses import asdict

from webnode.audit import MAX_LINES
from webnode.route import API, Field, Route, RouteRequest
from webnode.sanitize import Json


def list_events(request: RouteRequest) -> Json:
    """Return the entries of the event log, oldest first."""
    entries = request.services.event_log.list_since(request.values["after"], request.values["about"])
    return [asdict(entry) for entry in entries]


def list_audit(request: RouteRequest) -> Json:
    """Return the newest lines of the audit log."""
    return [*request.services.audit.list_newest(request.values["count"])]


ROUTES = (
    Route(
        "GET",
        f"{API}/events",
        "Events since this node started to observe the team, oldest first",
        "viewer",
        list_events,
        (
            Field("after", "whole", "number of the last event received", "query", minimum=0, default=0),
            Field(
                "about",
                "text",
                "uuid of a device or id of a task: only its events",
                "query",
                minimum=0,
                maximum=64,
                default="",
            ),
        ),
        response="a list of n, at, kind, uuid, task, text, seconds",
    ),
    Route(
        "GET",
        f"{API}/audit",
        "Changes made through this node, newest first",
        "operator",
        list_audit,
        (Field("count", "whole", "maximum number of lines", "query", minimum=1, maximum=MAX_LINES, default=50),),
        response="a list of at (unix seconds), who, role, from, session, route, target, outcome",
    ),
)
