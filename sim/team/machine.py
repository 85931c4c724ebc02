"""Simulate the computer of one node: its clock can drift, and the computer can be frozen, be suspended and die.

The machine is the clock of its node, and receives the node's datagrams and the bytes of its robot. Nothing runs on a
frozen machine. When the machine continues, overdue timers run first, then pending data is received, as in a reactor
after SIGCONT.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.error import AlreadyCalled, AlreadyCancelled
from twisted.internet.interfaces import IDelayedCall, IReactorTime
from zope.interface import implementer

from drivers.link import Connector, Link, LinkClient, Reconnector
from middleware.entangled.network.network import Address, Network, Receiver, find_ports

MIN_DELAY_S = 1e-6
"""Minimum delay of a timer in seconds, unless the delay is 0. A delay that is only a rounding error between two clocks
may be too small to advance the simulator's clock, and code that repeats such a wait would never end."""
MAX_QUEUED_DATAGRAMS = 200
"""Maximum number of datagrams queued for a frozen machine; more are dropped, as by a full socket buffer."""


@implementer(IDelayedCall)
class _MachineCall:
    """A scheduled call of a machine."""

    __slots__ = ("inner", "_machine", "_function", "_arguments", "_keywords", "_state")

    def __init__(self, machine: Machine, function: Callable[..., object], arguments: Any, keywords: Any) -> None:
        self.inner: IDelayedCall | None = None
        self._machine = machine
        self._function = function
        self._arguments = arguments
        self._keywords = keywords
        self._state = "waiting"

    def on_due(self) -> None:
        """Run the call, or queue it until the machine continues."""
        if self._machine.is_frozen:
            self._machine.overdue_calls.append(self)
        else:
            self.run()

    def run(self) -> None:
        """Make the call, unless it was cancelled."""
        if self._state == "waiting" and self._machine.is_alive:
            self._state = "called"
            self._function(*self._arguments, **self._keywords)

    def active(self) -> bool:
        """Return whether the call is still scheduled."""
        return self._state == "waiting"

    def cancel(self) -> None:
        """Cancel the call; raises ``AlreadyCalled`` or ``AlreadyCancelled``."""
        self._check()
        self._state = "cancelled"
        if self.inner is not None and self.inner.active():
            self.inner.cancel()

    def getTime(self) -> float:
        """Return the time of the call on the machine's clock."""
        assert self.inner is not None
        return self._machine.to_machine_time(self.inner.getTime())

    def reset(self, seconds: float) -> None:
        """Reschedule the call to ``seconds`` of the machine's clock from now."""
        self._check()
        if self.inner is not None and self.inner.active():
            self.inner.reset(seconds / self._machine.rate)

    def delay(self, seconds: float) -> None:
        """Postpone the call by ``seconds`` of the machine's clock."""
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
    """A computer whose clock runs ``rate`` times as fast as the simulator's clock, and starts at ``offset``."""

    COUNTS_SUSPENSION = True
    """Whether the clock continues during a suspension (CLOCK_BOOTTIME continues, CLOCK_MONOTONIC does not)."""

    def __init__(self, world: IReactorTime, rate: float = 1.0, offset: float = 0.0) -> None:
        self.rate = rate
        self.is_alive = True
        self.is_frozen = False
        self.overdue_calls: list[_MachineCall] = []
        self._pending_input: list[tuple[Callable[..., object], tuple[Any, ...]]] = []
        self._clock = world
        # The clock's value at the last change of its rate, and the simulator's time of that change.
        self._base_value = offset
        self._base_time = 0.0
        self._suspended_s = 0.0
        self._stopped_at: float | None = None

    def seconds(self) -> float:
        """Return the machine's time; it continues while the machine is frozen."""
        return self.to_machine_time(self._clock.seconds())

    def to_machine_time(self, moment: float) -> float:
        """Return the value of this clock at ``moment`` of the simulator's clock, if the rate does not change."""
        if self._stopped_at is not None:
            moment = self._stopped_at
        return self._base_value + self.rate * (moment - self._base_time)

    def to_simulator_time(self, shown: float) -> float:
        """Return the simulator's time at which this clock shows ``shown``, if the rate does not change."""
        return self._base_time + (shown - self._base_value) / self.rate

    def to_unsuspended_time(self, shown: float) -> float:
        """Return the simulator's time at which this clock would show ``shown`` if it had never been suspended."""
        return self.to_simulator_time(shown) - self._suspended_s

    def set_rate(self, rate: float) -> None:
        """Change the rate from now on; existing timers keep their times on the simulator's clock."""
        self._base_value, self._base_time = self.seconds(), self._clock.seconds()
        self.rate = rate

    def callLater(self, delay: float, callable: Callable[..., object], *args: Any, **kw: Any) -> IDelayedCall:  # noqa: A002
        """Schedule a call after ``delay`` seconds of the machine's clock."""
        call = _MachineCall(self, callable, args, kw)
        call.inner = self._clock.callLater(max(delay / self.rate, MIN_DELAY_S) if delay else 0.0, call.on_due)
        return call

    def getDelayedCalls(self) -> Sequence[IDelayedCall]:
        """Return all calls on the simulator's clock, which all machines share."""
        return list(self._clock.getDelayedCalls())

    def deliver(self, receive: Callable[..., object], *arguments: Any) -> None:
        """Deliver external input, now or when the machine continues."""
        if self.is_frozen:
            self._pending_input.append((receive, arguments))
        elif self.is_alive:
            receive(*arguments)

    def deliver_datagram(self, receive: Callable[..., object], *arguments: Any) -> None:
        """Deliver a datagram; a frozen machine queues at most ``MAX_QUEUED_DATAGRAMS``."""
        if not self.is_frozen or len(self._pending_input) < MAX_QUEUED_DATAGRAMS:
            self.deliver(receive, *arguments)

    def freeze(self, is_suspended: bool = False) -> None:
        """Stop the process like SIGSTOP, or suspend the whole machine."""
        self.is_frozen = True
        if is_suspended and not self.COUNTS_SUSPENSION:
            self._stopped_at = self._clock.seconds()

    def thaw(self) -> None:
        """Continue, with everything that is overdue."""
        self.is_frozen = False
        if self._stopped_at is not None:
            stopped = self._clock.seconds() - self._stopped_at
            self._stopped_at = None
            self._suspended_s += stopped
            self._base_time += stopped
        timers, self.overdue_calls = self.overdue_calls, []
        arrived, self._pending_input = self._pending_input, []
        for call in timers:
            call.run()
        for receive, arguments in arrived:
            if self.is_alive:
                receive(*arguments)

    def die(self) -> None:
        """Stop permanently."""
        self.is_alive = False
        self.overdue_calls.clear()
        self._pending_input.clear()


class MachineNetwork:
    """A network whose datagrams pass through a machine."""

    def __init__(self, machine: Machine, network: Network) -> None:
        self._machine = machine
        self._network = network
        self.send = network.send
        self.close = network.close
        self.ports = find_ports(network)

    @property
    def address(self) -> Address:
        """The node's address."""
        return self._network.address

    def listen(self, receiver: Receiver) -> None:
        """Open the port; datagrams reach ``receiver`` through the machine."""
        self._network.listen(lambda datagram, source: self._machine.deliver_datagram(receiver, datagram, source))


class MachineConnector:
    """A connector whose links pass through a machine."""

    def __init__(self, machine: Machine, connector: Connector) -> None:
        self._machine = machine
        self._connector = connector

    def connect(self, host: str, port: int, caller: LinkClient) -> Reconnector:
        """Open a link; its data reaches ``caller`` through the machine."""
        return self._connector.connect(host, port, _MachineCaller(self._machine, caller))


class _MachineCaller:
    def __init__(self, machine: Machine, caller: LinkClient) -> None:
        self._machine = machine
        self._caller = caller

    def link_up(self, link: Link) -> None:
        self._machine.deliver(self._caller.link_up, link)

    def link_down(self) -> None:
        self._machine.deliver(self._caller.link_down)

    def data_received(self, data: bytes) -> None:
        self._machine.deliver(self._caller.data_received, data)
