"""Routes of the events: what happened since this node looks."""

from __future__ import annotations

from dataclasses import asdict

from webnode.field import Json
from webnode.route import API, Ask, Field, Route


def events(ask: Ask) -> Json:
    """The entries of the chronicle, the oldest first."""
    entries = ask.board.chronicle.since(ask.given["after"], ask.given["about"])
    return [asdict(entry) for entry in entries]


ROUTES = (
    Route(
        "GET",
        f"{API}/events",
        "What happened since this node looks, the oldest first",
        "viewer",
        events,
        (
            Field("after", "whole", "number of the last one known", "query", least=0, default=0, is_required=False),
            Field(
                "about",
                "text",
                "uuid of a device or id of a task: only what concerns it",
                "query",
                least=0,
                most=64,
                default="",
                is_required=False,
            ),
        ),
        gives="a list of n, at, kind, uuid, task, text, seconds",
    ),
)
