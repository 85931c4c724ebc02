"""Routes of the settings of devices that can be changed while they run."""

from __future__ import annotations

from webnode.route import Route

ROUTES: tuple[Route, ...] = ()
