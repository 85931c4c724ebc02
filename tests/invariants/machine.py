"""Machine: one simulated computer with a clock of its own; it can be frozen, suspended, slow or fast, and die."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.interfaces import IDelayedCall, IReactorTime
from zope.interface import implementer

from middleware.entangled.clock import HeapClock


@implementer(IDelayedCall)
class _Call:
    """A call that a machine will make, unless it is cancelled or the machine dies first."""

    def __init__(self, machine: Machine, function: Callable[..., object], arguments: tuple[object, ...]) -> None:
        self._machine = machine
        self._function = function
        self._arguments = arguments
        self._is_active = True

    def cancel(self) -> None:
        self._is_active = False

    def active(self) -> bool:
        return self._is_active

    def getTime(self) -> float:
        raise NotImplementedError

    def delay(self, seconds: float) -> None:
        raise NotImplementedError

    def reset(self, seconds: float) -> None:
        raise NotImplementedError

    def due(self) -> None:
        """Run now, or when the machine goes on."""
        if self._machine.is_still:
            self._machine.backlog.append(self)
        elif self._is_active and self._machine.is_alive:
            self._is_active = False
            self._function(*self._arguments)


@implementer(IReactorTime)
class Machine:
    """A computer whose clock runs ``rate`` times as fast as the world's and began at ``offset``."""

    COUNTS_SUSPENSION = True
    """Whether its clock goes on while it is suspended (CLOCK_BOOTTIME does, CLOCK_MONOTONIC does not)."""
    MOST_WAITING = 200
    """Datagrams that wait for a machine that stands still; the rest is dropped, as a full socket buffer does."""

    def __init__(self, world: HeapClock, rate: float = 1.0, offset: float = 0.0) -> None:
        self.rate = rate
        self.is_alive = True
        self.is_still = False
        self.backlog: list[_Call] = []
        self._world = world
        self.offset = offset
        self._lost = 0.0
        self._suspended_at: float | None = None

    def seconds(self) -> float:
        """The machine's own moment."""
        now = self._world.seconds()
        lost = self._lost
        if self._suspended_at is not None and not self.COUNTS_SUSPENSION:
            lost += now - self._suspended_at
        return self.offset + self.rate * (now - lost)

    def callLater(self, delay: float, callable: Callable[..., object], *args: object, **kw: object) -> _Call:  # noqa: A002
        """Make a call after ``delay`` of the machine's own seconds."""
        call = _Call(self, callable, args)
        self._world.callLater(max(0.0, delay) / self.rate, call.due)
        return call

    def getDelayedCalls(self) -> Sequence[IDelayedCall]:
        """Not kept."""
        return ()

    def at(self, moment: float) -> float:
        """The world's moment at which this machine's clock shows ``moment``."""
        return (moment - self.offset) / self.rate + self._lost

    def truly(self, moment: float) -> float:
        """The world's moment at which a clock like this one that never stood still shows ``moment``."""
        return (moment - self.offset) / self.rate

    def take(self, deliver: Callable[..., object], *arguments: Any) -> None:
        """Take a datagram: at once, or when the machine goes on, or never."""
        if self.is_still and len(self.backlog) >= self.MOST_WAITING:
            return
        _Call(self, deliver, arguments).due()

    def freeze(self, is_suspended: bool = False) -> None:
        """Stand still: the process only (SIGSTOP), or the machine with its clocks (suspended)."""
        self.is_still = True
        if is_suspended:
            self._suspended_at = self._world.seconds()

    def thaw(self) -> None:
        """Go on: what has come due meanwhile is done now, in its order."""
        if self._suspended_at is not None:
            if not self.COUNTS_SUSPENSION:
                self._lost += self._world.seconds() - self._suspended_at
            self._suspended_at = None
        self.is_still = False
        backlog, self.backlog = self.backlog, []
        for call in backlog:
            call.due()

    def die(self) -> None:
        """Lose whatever was to be done."""
        self.is_alive = False
        self.backlog.clear()
