"""Web: the role of a node that serves the page: its code to sign in with, and what it needs to be installed."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from twisted.application.service import IService

from middleware.config.settings import Settings
from middleware.errors import BadSetting, MissingExtra
from middleware.node import SwarmNode
from swarmnode.seams import Seams


def with_code(settings: Settings, rng: random.Random) -> Settings:
    """``settings`` with a code to sign in with: made once, as a node that falls off the network comes back with it."""
    from webnode.password import draw_code

    web = settings.web
    return settings if web.code or not web.sign_in else replace(settings, web=replace(web, code=draw_code(rng)))


def web_page(settings: Settings, seams: Seams, reactor: Any, node: SwarmNode) -> IService:
    """The page over the node's data store; raises ``MissingExtra``, or ``BadSetting`` where TLS cannot be had."""
    try:
        from swarmnode.page import page
    except ModuleNotFoundError as error:
        raise MissingExtra("the web role", "web") from error
    return page(settings, seams, reactor, node, _doorway(settings) if settings.web.tls else None)


def _doorway(settings: Settings) -> Callable[..., Any]:
    """What makes the page's port over TLS; raises ``BadSetting`` where its libraries are missing."""
    try:
        from webnode.tls import door
    except ModuleNotFoundError as error:
        library = (error.name or "").split(".")[0]
        problem = f"is {settings.web.tls!r}, and the library {library} is not installed"
        remedy = "install it by: pip install 'swarm-node[tls]', or leave tls out"
        raise BadSetting(settings.origin, "[web] tls", problem, remedy) from error
    return door
