"""Table: every route of the API, in the order in which it is documented."""

from __future__ import annotations

from webnode.route import Route
from webnode.routes import (
    audit,
    devices,
    events,
    faults,
    halt,
    metrics,
    network,
    node,
    openapi,
    orders,
    phones,
    session,
    settings,
    tasks,
    yard,
)

TABLE: tuple[Route, ...] = (
    *node.ROUTES,
    *openapi.ROUTES,
    *session.ROUTES,
    *devices.ROUTES,
    *tasks.ROUTES,
    *orders.ROUTES,
    *halt.ROUTES,
    *yard.ROUTES,
    *settings.ROUTES,
    *network.ROUTES,
    *events.ROUTES,
    *faults.ROUTES,
    *phones.ROUTES,
    *audit.ROUTES,
    *metrics.ROUTES,
)
