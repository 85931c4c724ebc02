"""Routes of the metrics, for programs that watch."""

from __future__ import annotations

from webnode.errors import Refusal
from webnode.metrics import TEXT, metrics
from webnode.route import Ask, Content, Route


def read(ask: Ask) -> Content:
    """All of them."""
    try:
        return Content(metrics(ask.state, ask.board, ask.now), TEXT)
    except ModuleNotFoundError as error:
        if error.name != "prometheus_client":
            raise
        remedy = "install it by: pip install 'swarm-node[web]'"
        raise Refusal("metrics", "the node lacks the library prometheus-client", remedy, 404) from error


ROUTES = (
    Route("GET", "/metrics", "Figures of the team and the page, for Prometheus", "viewer", read, gives="text/plain"),
)
