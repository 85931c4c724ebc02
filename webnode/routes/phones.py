"""Routes of phones that take part as devices."""

from __future__ import annotations

from webnode.route import Route

ROUTES: tuple[Route, ...] = ()
