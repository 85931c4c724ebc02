"""Routes of the events: what happened since this node looks."""

from __future__ import annotations

from webnode.route import Route

ROUTES: tuple[Route, ...] = ()
