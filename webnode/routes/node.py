"""Routes of the node itself: who it is, everything that it knows, its streams, and what lets the page outlive it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

from webnode.fallback import Page
from webnode.field import Json
from webnode.route import API, DEVICE, Ask, Content, Field, Route

VERSION = 1
"""Of the API; a page of another one does not go on here."""
WORKER = Path(__file__).parents[1] / "static" / "sw.js"


def node(ask: Ask) -> Json:
    """Who answers; nothing that only those who have signed in may know."""
    board = ask.board
    pages = board.fallbacks.here()
    return {
        "node": next((page.node for page in pages if page.is_self), ""),
        "api": VERSION,
        "name": ask.state["node"],
        "sign_in": board.sessions.visitor("", ask.now).role == "anyone",
        "pages": rows(pages),
        "has": list(board.has),
    }


def rows(pages: Iterable[Page]) -> list[Json]:
    """The web nodes as the page is told them."""
    return [asdict(page) for page in pages]


def worker(ask: Ask) -> Content:
    """The service worker; what lies below /static could keep only what lies there."""
    return Content(WORKER.read_bytes(), "text/javascript; charset=utf-8")


def state(ask: Ask) -> Json:
    """Everything that the page shows."""
    return ask.state


ROUTES = (
    Route(
        "GET",
        f"{API}/node",
        "Who serves, and where else the team serves the page",
        "anyone",
        node,
        gives="node, api, name, sign_in, pages (node, url, is_secure, is_self), has",
    ),
    Route(
        "GET",
        "/sw.js",
        "What keeps the page in the browser when its node is gone",
        "anyone",
        worker,
        gives="text/javascript",
    ),
    Route(
        "GET", f"{API}/state", "Everything that the page shows", "viewer", state, gives="node, devices, tasks, groups"
    ),
    Route(
        "GET",
        "/events",
        "The state and its changes as server-sent events",
        "viewer",
        None,
        (
            Field("since", "text", "the last id heard", "query", least=0, most=40, default=""),
            Field("whole", "flag", "whole states, never changes", "query", default=False),
        ),
        gives="text/event-stream",
    ),
    Route(
        "GET",
        "/shot/{uuid}",
        "The newest picture of a camera, as soon as there is a newer one; 204 after five seconds without",
        "viewer",
        None,
        (
            DEVICE,
            Field("after", "text", "number of the last picture (X-Seq)", "query", least=0, default=""),
            Field("viewer", "text", "name of who looks", "query", least=0, most=40, default=""),
        ),
        gives="image/jpeg",
    ),
    Route("GET", "/static/{file}", "A file of the page", "anyone", None, (Field("file", "text", "its name", "path"),)),
)
