"""Gateway: the way of phones into the team, through the node that serves the page."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from middleware.node import SwarmNode
from middleware.settings import Settings
from swarmnode.seams import Seams

if TYPE_CHECKING:
    from webnode.board import Phones


def gateway(settings: Settings, seams: Seams, reactor: Any, node: SwarmNode) -> Phones | None:
    """The phones that take part through ``node``; None, as none can so far."""
    return None
