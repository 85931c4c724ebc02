"""Routes of faults that are caused on purpose."""

from __future__ import annotations

from webnode.route import Route

ROUTES: tuple[Route, ...] = ()
