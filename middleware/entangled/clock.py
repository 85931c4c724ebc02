"""Clock: simulated time on a heap, and Twisted's real time made monotonic.

Logic is handed something with ``seconds()`` and ``callLater()`` and never asks what drives it.  A simulation of ten
thousand nodes has tens of thousands of timers; Twisted's own test clock sorts its whole list at every call, this one
keeps a heap.
"""

from __future__ import annotations

import heapq
import itertools
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial

from twisted.internet.base import ReactorBase
from twisted.internet.error import AlreadyCalled, AlreadyCancelled
from twisted.internet.interfaces import IDelayedCall, IReactorTime
from zope.interface import implementer

_COMPACT_FROM = 64


def boot_time() -> Callable[[], float]:
    """The clock that no one sets: seconds since the machine started, those in which it was suspended included.

    Where the system has no such clock (CLOCK_BOOTTIME) it is ``time.monotonic``, which may stand still meanwhile.
    """
    if hasattr(time, "CLOCK_BOOTTIME"):
        return partial(time.clock_gettime, time.CLOCK_BOOTTIME)
    return time.monotonic


def use_monotonic_time() -> None:
    """Make every Twisted reactor of this process keep its timers on ``boot_time``.

    Twisted measures with ``time.time``: when the wall clock is set back a minute (NTP, a robot that gets GPS time),
    every timer stands still for that minute; when it is set forward, every pending time-out is due at once and a whole
    team suspects everybody.  ``time.monotonic`` stands still while the machine is suspended: who wakes up would take
    a lease for its own that has long gone to another.  On this clock whatever came due meanwhile is due at once, as
    after any long pause; a timer that is late says that there was one.

    Call this before timers are made; calling it again changes nothing.
    """
    ReactorBase.seconds = staticmethod(boot_time())


@implementer(IDelayedCall)
class _HeapCall:
    """A call that a ``HeapClock`` will make; ``order`` is its place among those of one moment, 0 when it is over."""

    __slots__ = ("time", "order", "_clock", "_function", "_arguments", "_keywords", "_is_cancelled")

    def __init__(
        self,
        clock: HeapClock,
        moment: float,
        order: int,
        function: Callable[..., object],
        arguments: tuple[object, ...],
        keywords: dict[str, object],
    ) -> None:
        self.time = moment
        self.order = order
        self._clock = clock
        self._function = function
        self._arguments = arguments
        self._keywords = keywords
        self._is_cancelled = False

    def getTime(self) -> float:
        """The moment at which the call is due, in seconds of its clock."""
        return self.time

    def cancel(self) -> None:
        """Unschedule the call; raises ``AlreadyCalled`` or ``AlreadyCancelled``."""
        self._check()
        self.order = 0
        self._is_cancelled = True
        # The entry stays in the heap for a while; what it was for shall not.
        self._function, self._arguments, self._keywords = _nothing, (), {}
        self._clock._dropped()

    def delay(self, seconds: float) -> None:
        """Move the call ``seconds`` after the moment for which it stands."""
        self._check()
        self._clock._move(self, self.time + seconds)

    def reset(self, seconds: float) -> None:
        """Move the call to ``seconds`` after now."""
        self._check()
        self._clock._move(self, self._clock.seconds() + seconds)

    def active(self) -> bool:
        """Whether the call still waits."""
        return self.order > 0

    def run(self) -> None:
        """Make the call; only its clock does this."""
        self.order = 0
        self._function(*self._arguments, **self._keywords)

    def _check(self) -> None:
        if self._is_cancelled:
            raise AlreadyCancelled
        if not self.order:
            raise AlreadyCalled


def _nothing() -> None:
    pass


@implementer(IReactorTime)
class HeapClock:
    """Time that moves only when it is told to; scheduling and running a call cost O(log n).

    Calls that are due at the same moment are made in the order in which they were scheduled.
    """

    def __init__(self, now: float = 0.0) -> None:
        self._now = now
        self._heap: list[tuple[float, int, _HeapCall]] = []
        self._orders = itertools.count(1)
        self._dead = 0

    def seconds(self) -> float:
        """The simulated moment, in seconds."""
        return self._now

    def callLater(self, delay: float, callable: Callable[..., object], *args: object, **kw: object) -> _HeapCall:  # noqa: A002
        """Schedule ``callable(*args, **kw)`` for ``delay`` seconds from now; ``delay`` may not be negative."""
        if delay < 0:
            raise ValueError(f"a call cannot be made {-delay} s ago")
        moment, order = self._now + delay, next(self._orders)
        call = _HeapCall(self, moment, order, callable, args, kw)
        heapq.heappush(self._heap, (moment, order, call))
        return call

    def getDelayedCalls(self) -> Sequence[IDelayedCall]:
        """The calls that wait, soonest first."""
        return [call for _, order, call in sorted(self._heap) if call.order == order]

    def run_until(self, moment: float) -> None:
        """Make every call that is due up to and with ``moment``, also those scheduled on the way, and stand there.

        An exception of a call passes through; the clock then stands at that call's moment.
        """
        heap, pop = self._heap, heapq.heappop
        while heap and heap[0][0] <= moment:
            due, order, call = pop(heap)
            if call.order != order:
                self._dead -= 1
                continue
            if due > self._now:
                self._now = due
            call.run()
            heap = self._heap
        self._now = max(self._now, moment)

    def advance(self, seconds: float) -> None:
        """Move time on by ``seconds``."""
        self.run_until(self._now + seconds)

    def leap(self, seconds: float) -> None:
        """Be suspended for ``seconds``: time passes and nothing is done; what came due is done late."""
        self._now += seconds

    def pump(self, steps: Iterable[float]) -> None:
        """Move time on by each of ``steps`` seconds in turn."""
        for step in steps:
            self.advance(step)

    def _move(self, call: _HeapCall, moment: float) -> None:
        call.time, call.order = moment, next(self._orders)
        heapq.heappush(self._heap, (moment, call.order, call))  # the older entry is known by its order, and skipped
        self._dropped()

    def _dropped(self) -> None:
        # Time-outs are mostly cancelled; without this, dead entries would make up nearly all of the heap.
        self._dead += 1
        if self._dead > _COMPACT_FROM and self._dead * 2 > len(self._heap):
            self._heap = [entry for entry in self._heap if entry[2].order == entry[1]]
            heapq.heapify(self._heap)
            self._dead = 0
