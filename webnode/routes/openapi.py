"""Routes of the API's own description."""

from __future__ import annotations

from typing import Any

from webnode.openapi import document
from webnode.route import API, Ask, Route


def openapi(ask: Ask) -> dict[str, Any]:
    """The document, from the table that is asked through."""
    return document(ask.table, str(ask.state["node"]))


ROUTES = (
    Route("GET", f"{API}/openapi.json", "This description, as OpenAPI 3.1", "viewer", openapi, gives="the document"),
)
