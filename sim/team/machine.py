"""The computer of one simulated node, with a clock of its own: it can be fast or slow, frozen, suspended, and die.

It is the clock of the node, and receives the node's datagrams and the bytes of its robot.  Nothing runs on a frozen
machine; when it continues, first its timers run that are overdue, then it receives what arrived, as a reactor does
after SIGCONT.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.error import AlreadyCalled, AlreadyCancelled
from twisted.internet.interfaces import IDelayedCall, IReactorTime
from zope.interface import implementer

from drivers.link import Caller, Connector, Line, Link
from middleware.entangled.network.network import Address, Network, Receiver, ports_of

LEAST = 1e-6
"""Seconds that a timer takes at least, unless it is due at once.  What is left of a wait after rounding two clocks may
be too little to move the world's: who waits for the rest again and again would wait for ever."""
MOST_WAITING = 200
"""Datagrams that wait for a machine that stands still; the rest is dropped, as a full socket buffer does."""


@implementer(IDelayedCall)
class _MachineCall:
    """A call that a machine will make, unless it is cancelled or the machine dies first."""

    __slots__ = ("inner", "_machine", "_function", "_arguments", "_keywords", "_state")

    def __init__(self, machine: Machine, function: Callable[..., object], arguments: Any, keywords: Any) -> None:
        self.inner: IDelayedCall | None = None
        self._machine = machine
        self._function = function
        self._arguments = arguments
        self._keywords = keywords
        self._state = "waiting"

    def due(self) -> None:
        """The moment has come: run, or wait until the machine goes on."""
        if self._machine.is_still:
            self._machine.timers.append(self)
        else:
            self.run()

    def run(self) -> None:
        """Make the call, unless it was cancelled meanwhile."""
        if self._state == "waiting" and self._machine.is_alive:
            self._state = "called"
            self._function(*self._arguments, **self._keywords)

    def active(self) -> bool:
        """Whether the call is still to come."""
        return self._state == "waiting"

    def cancel(self) -> None:
        """Unschedule the call; raises ``AlreadyCalled`` or ``AlreadyCancelled``."""
        self._check()
        self._state = "cancelled"
        if self.inner is not None and self.inner.active():
            self.inner.cancel()

    def getTime(self) -> float:
        """The moment at which the call is due, on the machine's clock."""
        assert self.inner is not None
        return self._machine.shown_at(self.inner.getTime())

    def reset(self, seconds: float) -> None:
        """Let it be due so many of the machine's seconds from now."""
        self._check()
        if self.inner is not None and self.inner.active():
            self.inner.reset(seconds / self._machine.rate)

    def delay(self, seconds: float) -> None:
        """Let it be due so many of the machine's seconds later."""
        self._check()
        if self.inner is not None and self.inner.active():
            self.inner.delay(seconds / self._machine.rate)

    def _check(self) -> None:
        if self._state == "called":
            raise AlreadyCalled
        if self._state == "cancelled":
            raise AlreadyCancelled


@implementer(IReactorTime)
class Machine:
    """A computer whose clock runs ``rate`` times as fast as the world's, and began at ``offset``."""

    COUNTS_SUSPENSION = True
    """Whether its clock goes on while it is suspended (CLOCK_BOOTTIME does, CLOCK_MONOTONIC does not)."""

    def __init__(self, world: IReactorTime, rate: float = 1.0, offset: float = 0.0) -> None:
        self.rate = rate
        self.is_alive = True
        self.is_still = False
        self.timers: list[_MachineCall] = []
        self._arrived: list[tuple[Callable[..., object], tuple[Any, ...]]] = []
        self._world = world
        # What the clock showed, and when, the last time that its rate was set.
        self._shown = offset
        self._since = 0.0
        self._lost = 0.0
        self._stopped_at: float | None = None

    def seconds(self) -> float:
        """The machine's own moment; it goes on while the machine stands still."""
        return self.shown_at(self._world.seconds())

    def shown_at(self, moment: float) -> float:
        """What its clock shows at a ``moment`` of the world's, if its rate stays."""
        if self._stopped_at is not None:
            moment = self._stopped_at
        return self._shown + self.rate * (moment - self._since)

    def at(self, shown: float) -> float:
        """The world's moment at which the clock shows that, if its rate stays."""
        return self._since + (shown - self._shown) / self.rate

    def unstopped_at(self, shown: float) -> float:
        """The world's moment at which the clock would show that if it had never stopped in a suspension."""
        return self.at(shown) - self._lost

    def set_rate(self, rate: float) -> None:
        """Run so fast from now on; timers that are set already are due when they were to be."""
        self._shown, self._since = self.seconds(), self._world.seconds()
        self.rate = rate

    def callLater(self, delay: float, callable: Callable[..., object], *args: Any, **kw: Any) -> IDelayedCall:  # noqa: A002
        """Make a call after ``delay`` of the machine's own seconds."""
        call = _MachineCall(self, callable, args, kw)
        call.inner = self._world.callLater(max(delay / self.rate, LEAST) if delay else 0.0, call.due)
        return call

    def getDelayedCalls(self) -> Sequence[IDelayedCall]:
        """The calls of everybody on the world's clock, for there is only one."""
        return list(self._world.getDelayedCalls())

    def heard(self, receive: Callable[..., object], *arguments: Any) -> None:
        """Hand in something from outside, now or when the machine goes on."""
        if self.is_still:
            self._arrived.append((receive, arguments))
        elif self.is_alive:
            receive(*arguments)

    def take(self, receive: Callable[..., object], *arguments: Any) -> None:
        """Hand in a datagram; while the machine stands still only so many wait."""
        if not self.is_still or len(self._arrived) < MOST_WAITING:
            self.heard(receive, *arguments)

    def freeze(self, is_suspended: bool = False) -> None:
        """Stop the process, as SIGSTOP does, or suspend the whole machine."""
        self.is_still = True
        if is_suspended and not self.COUNTS_SUSPENSION:
            self._stopped_at = self._world.seconds()

    def thaw(self) -> None:
        """Go on, with everything that is overdue."""
        self.is_still = False
        if self._stopped_at is not None:
            stopped = self._world.seconds() - self._stopped_at
            self._stopped_at = None
            self._lost += stopped
            self._since += stopped
        timers, self.timers = self.timers, []
        arrived, self._arrived = self._arrived, []
        for call in timers:
            call.run()
        for receive, arguments in arrived:
            if self.is_alive:
                receive(*arguments)

    def die(self) -> None:
        """Do nothing any more."""
        self.is_alive = False
        self.timers.clear()
        self._arrived.clear()


class MachineNetwork:
    """A network whose datagrams a machine receives."""

    def __init__(self, machine: Machine, network: Network) -> None:
        self._machine = machine
        self._network = network
        self.send = network.send
        self.close = network.close
        self.ports = ports_of(network)

    @property
    def address(self) -> Address:
        """The node's own address."""
        return self._network.address

    def listen(self, receiver: Receiver) -> None:
        """Open the port; what comes in goes to ``receiver`` by way of the machine."""
        self._network.listen(lambda datagram, source: self._machine.take(receiver, datagram, source))


class MachineConnector:
    """A connector whose links a machine reads."""

    def __init__(self, machine: Machine, connector: Connector) -> None:
        self._machine = machine
        self._connector = connector

    def call(self, host: str, port: int, caller: Caller) -> Line:
        """Open a link; what arrives on it goes to ``caller`` by way of the machine."""
        return self._connector.call(host, port, _MachineCaller(self._machine, caller))


class _MachineCaller:
    def __init__(self, machine: Machine, caller: Caller) -> None:
        self._machine = machine
        self._caller = caller

    def link_up(self, link: Link) -> None:
        self._machine.heard(self._caller.link_up, link)

    def link_down(self) -> None:
        self._machine.heard(self._caller.link_down)

    def received(self, data: bytes) -> None:
        self._machine.heard(self._caller.received, data)
