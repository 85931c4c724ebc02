"""Routes of the event log of the team and of this node's audit log."""

from __future__ import annotations

from dataclasses import asdict

from webnode.audit import AUDITED
from webnode.field import Json
from webnode.route import API, Ask, Field, Route


def events(ask: Ask) -> Json:
    """Return the entries of the chronicle, oldest first."""
    entries = ask.board.chronicle.since(ask.given["after"], ask.given["about"])
    return [asdict(entry) for entry in entries]


def audit(ask: Ask) -> Json:
    """Return the newest lines of the audit log."""
    return [*ask.board.audit.newest(ask.given["count"])]


ROUTES = (
    Route(
        "GET",
        f"{API}/events",
        "Events since this node started to observe the team, oldest first",
        "viewer",
        events,
        (
            Field("after", "whole", "number of the last event received", "query", least=0, default=0),
            Field(
                "about",
                "text",
                "uuid of a device or id of a task: only its events",
                "query",
                least=0,
                most=64,
                default="",
            ),
        ),
        gives="a list of n, at, kind, uuid, task, text, seconds",
    ),
    Route(
        "GET",
        f"{API}/audit",
        "Changes made through this node, newest first",
        "operator",
        audit,
        (Field("count", "whole", "maximum number of lines", "query", least=1, most=AUDITED, default=50),),
        gives="a list of at (unix seconds), who, role, from, session, route, target, outcome",
    ),
)
