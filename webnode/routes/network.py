"""Routes of the network: who knows whom."""

from __future__ import annotations

from webnode.route import Route

ROUTES: tuple[Route, ...] = ()
