"""Nodes as started by the command line, in virtual time, for tests."""

from __future__ import annotations

import random

from twisted.application.service import Service

from middleware.config.settings import Settings
from middleware.entangled.clock import HeapClock
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.network.switchboard import Switchboard
from middleware.node import SwarmNode
from swarmnode.dependencies import Dependencies
from swarmnode.service import NodeService

KEY = "of tests, and of nobody else"


class Page(Service):
    """A page that records the number of running pages."""

    def __init__(self, pages: list[Page]) -> None:
        pages.append(self)


class MemoryTeam:
    """A switchboard, a clock and the nodes that use them."""

    def __init__(self) -> None:
        self.clock = HeapClock()
        self.switchboard = Switchboard(self.clock, random.Random(1))
        self.pages: list[Page] = []

    def make_dependencies(self, name: str, port: int, store: MemoryStore | None = None) -> Dependencies:
        """Return the dependencies of one node."""
        return Dependencies(
            self.clock,
            lambda: self.switchboard.make_network("127.0.0.1", port),
            MemoryStore() if store is None else store,
            random.Random(name),
            self.clock.seconds,
        )

    def service(self, name: str, port: int, is_web: bool = False) -> NodeService:
        """Return a node that joins through port 7000."""
        known = [] if port == 7000 else ["127.0.0.1:7000"]
        settings = Settings.from_mapping(
            {"node": {"name": name, "port": port, "known_nodes": known, "team_key": KEY}}, "test"
        )
        return NodeService(settings, self.make_dependencies(name, port), [self.page] if is_web else [])

    def page(self, node: SwarmNode) -> Page:
        """Return the page of a running node."""
        assert node.running
        return Page(self.pages)
