"""Collect the routes of the API from the ``ROUTES`` of each module of this package."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from webnode import routes
from webnode.route import Route

_MODULES = [module.name for module in iter_modules(routes.__path__) if module.name != "registry"]
TABLE: tuple[Route, ...] = tuple(route for name in _MODULES for route in import_module(f"webnode.routes.{name}").ROUTES)
