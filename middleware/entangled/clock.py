"""Provide simulated time on a heap, and make Twisted's real time monotonic.

Protocol code receives an object with ``seconds()`` and ``callLater()``, which may be the simulated clock or the real
reactor.  A simulation of ten thousand nodes has tens of thousands of timers.  Twisted's test clock sorts its whole list
at every call, whereas ``HeapClock`` uses a heap.
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


def find_boot_clock() -> Callable[[], float]:
    """Return a clock of the seconds since the machine started, suspensions included; it ignores the wall clock.

    On systems without CLOCK_BOOTTIME it is ``time.monotonic``, which may stop during suspension.
    """
    if hasattr(time, "CLOCK_BOOTTIME"):
        return partial(time.clock_gettime, time.CLOCK_BOOTTIME)
    return time.monotonic


def use_monotonic_time() -> None:
    """Make every Twisted reactor of this process use ``find_boot_clock`` for its timers.

    Twisted uses ``time.time``: if the wall clock is set back a minute (NTP, a robot that gets GPS time), every timer
    stops for that minute; if it is set forward, every pending timeout expires immediately and all nodes suspect each
    other.  ``time.monotonic`` stops while the machine is suspended, so a node that resumes would consider its lease
    valid although another node has obtained it.  With ``find_boot_clock``, timers that expired during a suspension fire
    immediately after it, and a late timer indicates a pause.

    Call this before timers are created; repeated calls have no effect.
    """
    ReactorBase.seconds = staticmethod(find_boot_clock())


@implementer(IDelayedCall)
class _HeapCall:
    """A call of a ``HeapClock``; ``order`` is its position among simultaneous calls, 0 if it ran or was cancelled."""

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
        """Return the time at which the call is due, in seconds of its clock."""
        return self.time

    def cancel(self) -> None:
        """Cancel the call; raises ``AlreadyCalled`` or ``AlreadyCancelled``."""
        self._check()
        self.order = 0
        self._is_cancelled = True
        # The entry stays in the heap for some time; release the objects that it refers to.
        self._function, self._arguments, self._keywords = _do_nothing, (), {}
        self._clock._count_dead_entry()

    def delay(self, seconds: float) -> None:
        """Postpone the call by ``seconds``."""
        self._check()
        self._clock._move(self, self.time + seconds)

    def reset(self, seconds: float) -> None:
        """Move the call to ``seconds`` from now."""
        self._check()
        self._clock._move(self, self._clock.seconds() + seconds)

    def active(self) -> bool:
        """Return whether the call is pending."""
        return self.order > 0

    def run(self) -> None:
        """Make the call; only the clock calls this."""
        self.order = 0
        self._function(*self._arguments, **self._keywords)

    def _check(self) -> None:
        if self._is_cancelled:
            raise AlreadyCancelled
        if not self.order:
            raise AlreadyCalled


def _do_nothing() -> None:
    pass


@implementer(IReactorTime)
class HeapClock:
    """A clock that advances only on request; scheduling and running a call cost O(log n).

    Calls that are due at the same time run in the order in which they were scheduled.
    """

    def __init__(self, now: float = 0.0) -> None:
        self._now = now
        self._heap: list[tuple[float, int, _HeapCall]] = []
        self._orders = itertools.count(1)
        self._dead_entries = 0

    def seconds(self) -> float:
        """Return the simulated time in seconds."""
        return self._now

    def callLater(self, delay: float, callable: Callable[..., object], *args: object, **kw: object) -> _HeapCall:  # noqa: A002
        """Schedule ``callable(*args, **kw)`` for ``delay`` seconds from now; ``delay`` must not be negative."""
        if delay < 0:
            raise ValueError(f"the delay must not be negative, is {delay} s")
        moment, order = self._now + delay, next(self._orders)
        call = _HeapCall(self, moment, order, callable, args, kw)
        heapq.heappush(self._heap, (moment, order, call))
        return call

    def getDelayedCalls(self) -> Sequence[IDelayedCall]:
        """Return the pending calls, earliest first."""
        return [call for _, order, call in sorted(self._heap) if call.order == order]

    def run_until(self, moment: float) -> None:
        """Run all calls that are due up to ``moment``, including new ones, and set the time to ``moment``.

        An exception of a call propagates; the clock then stays at that call's time.
        """
        heap, pop = self._heap, heapq.heappop
        while heap and heap[0][0] <= moment:
            due, order, call = pop(heap)
            if call.order != order:
                self._dead_entries -= 1
                continue
            if due > self._now:
                self._now = due
            call.run()
            heap = self._heap
        self._now = max(self._now, moment)

    def advance(self, seconds: float) -> None:
        """Advance the time by ``seconds``."""
        self.run_until(self._now + seconds)

    def suspend(self, seconds: float) -> None:
        """Simulate a suspension of ``seconds``: advance the time without running the calls that become due."""
        self._now += seconds

    def pump(self, steps: Iterable[float]) -> None:
        """Advance the time by each of ``steps`` seconds in turn."""
        for step in steps:
            self.advance(step)

    def _move(self, call: _HeapCall, moment: float) -> None:
        call.time, call.order = moment, next(self._orders)
        heapq.heappush(self._heap, (moment, call.order, call))  # an older entry of this call is skipped by its order
        self._count_dead_entry()

    def _count_dead_entry(self) -> None:
        # Most timeouts are cancelled; unless cancelled entries are removed, they make up nearly all of the heap.
        self._dead_entries += 1
        if self._dead_entries > _COMPACT_FROM and self._dead_entries * 2 > len(self._heap):
            self._heap = [entry for entry in self._heap if entry[2].order == entry[1]]
            heapq.heapify(self._heap)
            self._dead_entries = 0
