"""Routes of the halt of the whole team."""

from __future__ import annotations

from webnode.route import Route

ROUTES: tuple[Route, ...] = ()
