"""Routes of the node itself: its identity, the state, its streams, and the service worker."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

from webnode.failover import Page
from webnode.route import API, DEVICE, Content, Field, Route, RouteRequest
from webnode.sanitize import Json

VERSION = 1
"""Version of the API; a page of another version does not switch to this node."""
WORKER_FILE = Path(__file__).parents[1] / "static" / "sw.js"


def read_node(request: RouteRequest) -> Json:
    """Return the identity of this node, with nothing that requires signing in."""
    services = request.services
    pages = services.fallbacks.list_pages()
    return {
        "node": next((page.node for page in pages if page.is_self), ""),
        "api": VERSION,
        "name": request.state["node"],
        "sign_in": services.sessions.authenticate("", request.now).role == "anyone",
        "pages": make_page_rows(pages),
        "has": list(services.feature_names),
    }


def make_page_rows(pages: Iterable[Page]) -> list[Json]:
    """Return the web nodes as JSON."""
    return [asdict(page) for page in pages]


def read_worker(request: RouteRequest) -> Content:
    """Return the service worker; its scope would be limited to /static if it were served there."""
    return Content(WORKER_FILE.read_bytes(), "text/javascript; charset=utf-8")


def read_state(request: RouteRequest) -> Json:
    """Return the whole state that the page shows."""
    return request.state


ROUTES = (
    Route(
        "GET",
        f"{API}/node",
        "The serving node, and the URLs of the team's other web nodes",
        "anyone",
        read_node,
        response="node, api, name, sign_in, pages (node, url, is_secure, is_self), has",
    ),
    Route(
        "GET",
        "/sw.js",
        "The service worker, which keeps the page in the browser",
        "anyone",
        read_worker,
        response="text/javascript",
    ),
    Route(
        "GET",
        f"{API}/state",
        "The state that the page shows",
        "viewer",
        read_state,
        response="node, devices, tasks, groups",
    ),
    Route(
        "GET",
        "/events",
        "The state and its changes as server-sent events",
        "viewer",
        None,
        (
            Field("since", "text", "the last event id received", "query", minimum=0, maximum=40, default=""),
            Field("whole", "flag", "send whole states instead of changes", "query", default=False),
        ),
        response="text/event-stream",
    ),
    Route(
        "GET",
        "/shot/{uuid}",
        "The newest picture of a camera, as soon as its number differs; 204 after five seconds without a new picture",
        "viewer",
        None,
        (
            DEVICE,
            Field("after", "text", "number of the last picture (X-Seq)", "query", minimum=0, default=""),
            Field("viewer", "text", "name of the viewer", "query", minimum=0, maximum=40, default=""),
        ),
        response="image/jpeg",
    ),
    Route("GET", "/static/{file}", "A file of the page", "anyone", None, (Field("file", "text", "file name", "path"),)),
)
