"""NodeService: a node of a team as a Twisted service, which can fall off the network and come back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from twisted.application.service import IService, Service
from twisted.internet.defer import Deferred, gatherResults, maybeDeferred
from twisted.internet.interfaces import IDelayedCall
from twisted.logger import Logger

from middleware.config.settings import Settings
from middleware.node import SwarmNode
from swarmnode.assembly import FAULTS, assembled
from swarmnode.seams import Seams

COMING_BACK = 2.0
"""Seconds until a node that could not come back tries again."""


class NodeService(Service):
    """One node of a team, with what its roles add; it can fall off the network for a while and come back.

    ``fronts`` make what people speak to of a node that runs, such as its page; they come and go with their node.
    """

    _log = Logger()

    def __init__(
        self, settings: Settings, seams: Seams, fronts: Sequence[Callable[[SwarmNode], IService]] = ()
    ) -> None:
        self.settings = settings
        self.assembly = assembled(settings, seams)
        self._seams = seams
        self._fronts = fronts
        self._open: list[IService] = []
        self._coming: IDelayedCall | None = None

    def startService(self) -> None:
        """Open the port and join; raises one of ``FAULTS`` where that cannot be."""
        super().startService()
        self._rise()

    def stopService(self) -> Deferred[None]:
        """Stop the robot, say goodbye, and close the store."""
        super().stopService()
        if self._coming is not None and self._coming.active():
            self._coming.cancel()
        # What the agent held is given back while the node still speaks: so another goes on at once.
        ended = self._end_agent().addBoth(lambda _: self.assembly.node.stopService())
        down = gatherResults([ended, self._end_fronts()])
        return down.addBoth(lambda _: self._seams.store.close())

    def vanish(self) -> None:
        """Stop at once and without a word, as when the power fails; the robot's link breaks, too."""
        # The node first: afterwards the agent can tell nobody, not even that it gives its lease back.
        self.assembly.node.vanish()
        self._end_agent()
        self._end_fronts()

    def leave(self, seconds: float) -> None:
        """Fall off the network, robot and all, and come back after ``seconds``."""
        if self._coming is None and self.running:
            self._log.info("{name} leaves the network for {s:g} s", name=self.settings.node.name, s=seconds)
            self.vanish()
            self._coming = self._seams.clock.callLater(seconds, self._return)

    def _return(self) -> None:
        self._coming = None
        try:
            self.assembly = assembled(self.settings, self._seams)
            self._rise()
        except FAULTS as error:
            self._log.warn("{name} cannot come back yet: {error}", name=self.settings.node.name, error=error)
            self.vanish()
            self._coming = self._seams.clock.callLater(COMING_BACK, self._return)

    def _rise(self) -> None:
        node, agent = self.assembly.node, self.assembly.agent
        node.on_disconnect(self.leave)
        node.startService()
        if agent is not None:
            agent.startService()
        for front in self._fronts:
            self._open.append(front(node))
            self._open[-1].startService()

    def _end_agent(self) -> Deferred[object]:
        agent = self.assembly.agent
        return maybeDeferred(lambda: agent.stopService() if agent is not None and agent.running else None)

    def _end_fronts(self) -> Deferred[Any]:
        ended, self._open = self._open, []
        return gatherResults([maybeDeferred(front.stopService) for front in ended])
