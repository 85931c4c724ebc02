"""Routes of the session: signing in and out."""

from __future__ import annotations

from webnode.route import Route

ROUTES: tuple[Route, ...] = ()
