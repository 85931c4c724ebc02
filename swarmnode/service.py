"""A node of a team as a Twisted service that can leave the network and return."""

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
"""Seconds between attempts to return to the network."""


class NodeService(Service):
    """One node of a team with the services of its roles; it can leave the network for a while and return.

    ``fronts`` create the services of a running node, such as its page; they start and stop with the node.
    """

    _log = Logger()

    def __init__(
        self, settings: Settings, seams: Seams, fronts: Sequence[Callable[[SwarmNode], IService]] = ()
    ) -> None:
        self.settings = settings
        self.assembly = assembled(settings, seams)
        self._seams = seams
        self._fronts = fronts
        self._open_fronts: list[IService] = []
        self._return_call: IDelayedCall | None = None

    def startService(self) -> None:
        """Open the port and join; raises one of ``FAULTS`` if that fails."""
        super().startService()
        self._start_parts()

    def stopService(self) -> Deferred[None]:
        """Stop the robot, leave the network, and close the store."""
        super().stopService()
        if self._return_call is not None and self._return_call.active():
            self._return_call.cancel()
        # The agent releases its lease while the node still runs, so another device continues at once.
        ended = self._stop_agent().addBoth(lambda _: self.assembly.node.stopService())
        down = gatherResults([ended, self._stop_fronts()])
        return down.addBoth(lambda _: self._seams.store.close())

    def vanish(self) -> None:
        """Stop immediately without sending anything, as in a power failure; the robot's link breaks as well."""
        # Stop the node first, so the agent cannot send anything, not even the release of its lease.
        self.assembly.node.vanish()
        self._stop_agent()
        self._stop_fronts()

    def leave(self, seconds: float) -> None:
        """Leave the network with the robot, and return after ``seconds``."""
        if self._return_call is None and self.running:
            self._log.info("{name} leaves the network for {s:g} s", name=self.settings.node.name, s=seconds)
            self.vanish()
            self._return_call = self._seams.clock.callLater(seconds, self._rejoin)

    def _rejoin(self) -> None:
        self._return_call = None
        try:
            self.assembly = assembled(self.settings, self._seams)
            self._start_parts()
        except FAULTS as error:
            self._log.warn("{name} cannot rejoin the network yet: {error}", name=self.settings.node.name, error=error)
            self.vanish()
            self._return_call = self._seams.clock.callLater(COMING_BACK, self._rejoin)

    def _start_parts(self) -> None:
        node, agent = self.assembly.node, self.assembly.agent
        node.on_disconnect(self.leave)
        node.startService()
        if agent is not None:
            agent.startService()
        for front in self._fronts:
            self._open_fronts.append(front(node))
            self._open_fronts[-1].startService()

    def _stop_agent(self) -> Deferred[object]:
        agent = self.assembly.agent
        return maybeDeferred(lambda: agent.stopService() if agent is not None and agent.running else None)

    def _stop_fronts(self) -> Deferred[Any]:
        ended, self._open_fronts = self._open_fronts, []
        return gatherResults([maybeDeferred(front.stopService) for front in ended])
