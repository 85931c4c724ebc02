"""Routes of the audit: who changed what."""

from __future__ import annotations

from webnode.route import Route

ROUTES: tuple[Route, ...] = ()
