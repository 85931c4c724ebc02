"""Frost: one node's view of the world that can stand still, as that of a process between SIGSTOP and SIGCONT.

While it is frozen no timer of the node runs and nothing reaches it; what was due and what arrived is waiting when it
thaws: first the timers, then what came in, as a reactor does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet.error import AlreadyCalled, AlreadyCancelled
from twisted.internet.interfaces import IDelayedCall, IReactorTime
from zope.interface import implementer

from drivers.sim.link import Caller, Connector, Line, Link
from middleware.entangled.network.network import Address, Network, Receiver


@implementer(IDelayedCall)
class _FrostCall:
    """A call of a node, which a frozen one does not make yet."""

    def __init__(self, frost: Frost, function: Callable[..., object], arguments: Any, keywords: Any) -> None:
        self.inner: IDelayedCall | None = None
        self.state = "waiting"
        self._frost = frost
        self._work = (function, arguments, keywords)

    def due(self) -> None:
        """The moment has come."""
        if self._frost.is_frozen:
            self._frost.timers.append(self)
        else:
            self.run()

    def run(self) -> None:
        """Make the call, unless it was cancelled meanwhile."""
        if self.state == "waiting":
            self.state = "called"
            function, arguments, keywords = self._work
            function(*arguments, **keywords)

    def active(self) -> bool:
        """Whether the call is still to come."""
        return self.state == "waiting"

    def cancel(self) -> None:
        """Unschedule the call; raises ``AlreadyCalled`` or ``AlreadyCancelled``."""
        self._check()
        self.state = "cancelled"
        if self.inner is not None and self.inner.active():
            self.inner.cancel()

    def getTime(self) -> float:
        """The moment at which the call is due."""
        assert self.inner is not None
        return self.inner.getTime()

    def reset(self, seconds: float) -> None:
        """Let it be due so many seconds from now."""
        self._check()
        if self.inner is not None and self.inner.active():
            self.inner.reset(seconds)

    def delay(self, seconds: float) -> None:
        """Let it be due so many seconds later."""
        self._check()
        if self.inner is not None and self.inner.active():
            self.inner.delay(seconds)

    def _check(self) -> None:
        if self.state == "called":
            raise AlreadyCalled
        if self.state == "cancelled":
            raise AlreadyCancelled


@implementer(IReactorTime)
class Frost:
    """The clock of one node, and what its other ways to the world go through; ``freeze`` and ``thaw`` it."""

    def __init__(self, clock: IReactorTime) -> None:
        self.is_frozen = False
        self.timers: list[_FrostCall] = []
        self._clock = clock
        self._arrived: list[tuple[Callable[..., object], tuple[Any, ...]]] = []

    def freeze(self) -> None:
        """Stop the node as SIGSTOP does; its clock goes on, as a real one would."""
        self.is_frozen = True

    def thaw(self) -> None:
        """Let the node go on, with everything that is overdue."""
        self.is_frozen = False
        timers, self.timers = self.timers, []
        for call in timers:
            call.run()
        arrived, self._arrived = self._arrived, []
        for receive, arguments in arrived:
            receive(*arguments)

    def heard(self, receive: Callable[..., object], *arguments: Any) -> None:
        """Hand in something from outside, now or at the thaw."""
        if self.is_frozen:
            self._arrived.append((receive, arguments))
        else:
            receive(*arguments)

    def seconds(self) -> float:
        """The clock's time."""
        return self._clock.seconds()

    def callLater(self, delay: float, callable: Callable[..., object], *args: Any, **kw: Any) -> IDelayedCall:
        """Schedule a call of the node."""
        call = _FrostCall(self, callable, args, kw)
        call.inner = self._clock.callLater(delay, call.due)
        return call

    def getDelayedCalls(self) -> list[IDelayedCall]:
        """The calls of everybody on the clock, for there is only one."""
        return list(self._clock.getDelayedCalls())

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
