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
from swarmnode.assembly import EXPECTED_ERRORS, assemble_node
from swarmnode.dependencies import Dependencies

REJOIN_RETRY_S = 2.0
"""Seconds between attempts to return to the network."""


class NodeService(Service):
    """One node of a team with the services of its roles; it can leave the network for a while and return.

    ``fronts`` create the services of a running node, such as its page; they start and stop with the node.
    """

    _log = Logger()

    def __init__(
        self, settings: Settings, dependencies: Dependencies, fronts: Sequence[Callable[[SwarmNode], IService]] = ()
    ) -> None:
        self.settings = settings
        self.assembly = assemble_node(settings, dependencies)
        self._dependencies = dependencies
        self._fronts = fronts
        self._open_fronts: list[IService] = []
        self._rejoin_call: IDelayedCall | None = None

    def startService(self) -> None:
        """Open the port and join; raises one of ``EXPECTED_ERRORS`` if that fails."""
        super().startService()
        self._start_parts()

    def stopService(self) -> Deferred[None]:
        """Stop the robot, leave the network, and close the store."""
        super().stopService()
        if self._rejoin_call is not None and self._rejoin_call.active():
            self._rejoin_call.cancel()
        # The agent releases its lease while the node still runs, so another device continues immediately.
        ended = self._stop_agent().addBoth(lambda _: self.assembly.node.stopService())
        down = gatherResults([ended, self._stop_fronts()])
        return down.addBoth(lambda _: self._dependencies.store.close())

    def vanish(self) -> None:
        """Stop immediately without sending anything, as in a power failure; the robot's link breaks as well."""
        # Stop the node first, so the agent cannot send anything, not even the release of its lease.
        self.assembly.node.stop_silently()
        self._stop_agent()
        self._stop_fronts()

    def leave_for(self, seconds: float) -> None:
        """Leave the network and disconnect the robot as in a failure; return after ``seconds``."""
        if self._rejoin_call is None and self.running:
            self._log.info("{name} leaves the network for {s:g} s", name=self.settings.node.name, s=seconds)
            self.vanish()
            self._rejoin_call = self._dependencies.clock.callLater(seconds, self._rejoin)

    def _rejoin(self) -> None:
        self._rejoin_call = None
        try:
            self.assembly = assemble_node(self.settings, self._dependencies)
            self._start_parts()
        except EXPECTED_ERRORS as error:
            self._log.warn("{name} cannot rejoin the network yet: {error}", name=self.settings.node.name, error=error)
            self.vanish()
            self._rejoin_call = self._dependencies.clock.callLater(REJOIN_RETRY_S, self._rejoin)

    def _start_parts(self) -> None:
        node, agent = self.assembly.node, self.assembly.agent
        node.on_disconnect(self.leave_for)
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
