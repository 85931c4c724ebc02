"""Frost: one node's view of the world that can stand still, as that of a process between SIGSTOP and SIGCONT.

While it is frozen no timer of the node runs and nothing reaches it; what was due and what arrived is waiting when it
thaws: first the timers, then what came in, as a reactor does.
"""

from __future__ import annotations

from drivers.link import Caller, Connector, Line, Link
from middleware.entangled.network.network import Address, Network, Receiver, ports_of
from sim.team.machine import Machine


class Frost(Machine):
    """The clock of one node, and what its other ways to the world go through; ``freeze`` and ``thaw`` it."""

    def network(self, network: Network) -> Network:
        """``network``, heard only while not frozen."""
        return _FrostNetwork(self, network)

    def connector(self, connector: Connector) -> Connector:
        """``connector``, whose links are heard only while not frozen."""
        return _FrostConnector(self, connector)


class _FrostNetwork:
    def __init__(self, frost: Frost, network: Network) -> None:
        self._frost = frost
        self._network = network
        self.send = network.send
        self.ports = ports_of(network)
        self.close = network.close

    @property
    def address(self) -> Address:
        return self._network.address

    def listen(self, receiver: Receiver) -> None:
        self._network.listen(lambda datagram, source: self._frost.heard(receiver, datagram, source))


class _FrostConnector:
    def __init__(self, frost: Frost, connector: Connector) -> None:
        self._frost = frost
        self._connector = connector

    def call(self, host: str, port: int, caller: Caller) -> Line:
        return self._connector.call(host, port, _FrostCaller(self._frost, caller))


class _FrostCaller:
    def __init__(self, frost: Frost, caller: Caller) -> None:
        self._frost = frost
        self._caller = caller

    def link_up(self, link: Link) -> None:
        self._frost.heard(self._caller.link_up, link)

    def link_down(self) -> None:
        self._frost.heard(self._caller.link_down)

    def received(self, data: bytes) -> None:
        self._frost.heard(self._caller.received, data)
