"""Routes of what happened: in the team since this node looks, and through this node by order of whom."""

from __future__ import annotations

from dataclasses import asdict

from webnode.audit import AUDITED
from webnode.field import Json
from webnode.route import API, Ask, Field, Route


def events(ask: Ask) -> Json:
    """The entries of the chronicle, the oldest first."""
    entries = ask.board.chronicle.since(ask.given["after"], ask.given["about"])
    return [asdict(entry) for entry in entries]


def audit(ask: Ask) -> Json:
    """The newest lines of the audit."""
    return [*ask.board.audit.newest(ask.given["count"])]


ROUTES = (
    Route(
        "GET",
        f"{API}/events",
        "What happened since this node looks, the oldest first",
        "viewer",
        events,
        (
            Field("after", "whole", "number of the last one known", "query", least=0, default=0),
            Field(
                "about",
                "text",
                "uuid of a device or id of a task: only what concerns it",
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
        "Who changed what through this node, the newest first",
        "operator",
        audit,
        (Field("count", "whole", "how many", "query", least=1, most=AUDITED, default=50),),
        gives="a list of at (unix seconds), who, role, from, session, route, target, outcome",
    ),
)
