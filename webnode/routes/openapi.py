"""Routes of the API's own description."""

from __future__ import annotations

from webnode.route import Route

ROUTES: tuple[Route, ...] = ()
