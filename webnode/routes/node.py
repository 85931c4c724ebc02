"""Routes of the node itself: its identity, the state, its streams, and the service worker."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

from webnode.fallback import Page
from webnode.field import Json
from webnode.route import API, DEVICE, Ask, Content, Field, Route

VERSION = 1
"""Version of the API; a page of another version does not switch to this node."""
WORKER = Path(__file__).parents[1] / "static" / "sw.js"


def node(ask: Ask) -> Json:
    """Return the identity of this node, with nothing that requires signing in."""
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
    """Return the web nodes as JSON."""
    return [asdict(page) for page in pages]


def worker(ask: Ask) -> Content:
    """Return the service worker; its scope would be limited to /static if it were served there."""
    return Content(WORKER.read_bytes(), "text/javascript; charset=utf-8")


def state(ask: Ask) -> Json:
    """Return the whole state that the page shows."""
    return ask.state


ROUTES = (
    Route(
        "GET",
        f"{API}/node",
        "The serving node, and the URLs of the team's other web nodes",
        "anyone",
        node,
        gives="node, api, name, sign_in, pages (node, url, is_secure, is_self), has",
    ),
    Route(
        "GET",
        "/sw.js",
        "The service worker, which keeps the page in the browser",
        "anyone",
        worker,
        gives="text/javascript",
    ),
    Route(
        "GET", f"{API}/state", "The state that the page shows", "viewer", state, gives="node, devices, tasks, groups"
    ),
    Route(
        "GET",
        "/events",
        "The state and its changes as server-sent events",
        "viewer",
        None,
        (
            Field("since", "text", "the last event id received", "query", least=0, most=40, default=""),
            Field("whole", "flag", "send whole states instead of changes", "query", default=False),
        ),
        gives="text/event-stream",
    ),
    Route(
        "GET",
        "/shot/{uuid}",
        "The newest picture of a camera, as soon as there is a new one; 204 after five seconds without",
        "viewer",
        None,
        (
            DEVICE,
            Field("after", "text", "number of the last picture (X-Seq)", "query", least=0, default=""),
            Field("viewer", "text", "name of the viewer", "query", least=0, most=40, default=""),
        ),
        gives="image/jpeg",
    ),
    Route("GET", "/static/{file}", "A file of the page", "anyone", None, (Field("file", "text", "file name", "path"),)),
)
