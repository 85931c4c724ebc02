"""Routes of the audit: who changed what."""

from __future__ import annotations

from webnode.board import AUDITED
from webnode.field import Json
from webnode.route import API, Ask, Field, Route


def newest(ask: Ask) -> Json:
    """The newest lines."""
    return [*ask.board.audit.newest(ask.given["count"])]


ROUTES = (
    Route(
        "GET",
        f"{API}/audit",
        "Who changed what through this node, the newest first",
        "operator",
        newest,
        (Field("count", "whole", "how many", "query", least=1, most=AUDITED, default=50, is_required=False),),
        gives="a list of at (unix seconds), who, role, from, session, route, target, outcome",
    ),
)
