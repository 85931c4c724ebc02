"""Routes of the metrics, for programs that watch."""

from __future__ import annotations

from webnode.route import Route

ROUTES: tuple[Route, ...] = ()
