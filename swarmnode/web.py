"""The web role of a node: its sign-in code and the import of the page."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from twisted.application.service import IService

from middleware.config.settings import Settings
from middleware.errors import BadSetting, MissingExtra
from middleware.node import SwarmNode
from swarmnode.dependencies import Dependencies


def add_sign_in_code(settings: Settings, rng: random.Random) -> Settings:
    """Return ``settings`` with a sign-in code that stays the same when the node rejoins."""
    from webnode.password import draw_code

    web = settings.web
    return settings if web.code or not web.sign_in else replace(settings, web=replace(web, code=draw_code(rng)))


def make_web_page(settings: Settings, dependencies: Dependencies, reactor: Any, node: SwarmNode) -> IService:
    """Return the page that shows the node's data store; raises ``MissingExtra``, or ``BadSetting`` without TLS."""
    try:
        from swarmnode.page import make_page_service
    except ModuleNotFoundError as error:
        raise MissingExtra("the web role", "web") from error
    return make_page_service(
        settings, dependencies, reactor, node, _load_tls_factory(settings) if settings.web.tls else None
    )


def _load_tls_factory(settings: Settings) -> Callable[..., Any]:
    """Return the factory of the page's TLS port; raises ``BadSetting`` if its libraries are missing."""
    try:
        from webnode.tls import make_tls_port
    except ModuleNotFoundError as error:
        library = (error.name or "").split(".")[0]
        problem = f"is {settings.web.tls!r}, but the library {library} is not installed"
        remedy = "install it by: pip install 'swarm-node[tls]', or remove tls"
        raise BadSetting(settings.origin, "[web] tls", problem, remedy) from error
    return make_tls_port
