"""Run the background timers and coroutines of a node on one clock, and cancel them when the node stops."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Iterable
from contextlib import suppress
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime
from twisted.logger import Logger

from middleware.entangled.errors import EntangledError


def cancel(timer: IDelayedCall | None) -> None:
    """Cancel a timer if it is set and pending."""
    if timer is not None and timer.active():
        timer.cancel()


class Background:
    """Timers and coroutines of one node; none of them runs after ``stop``."""

    _log = Logger()

    def __init__(self, clock: IReactorTime) -> None:
        self._clock = clock
        self._calls: dict[IDelayedCall, None] = {}
        self.is_stopped = False

    def later(self, delay: float, work: Callable[..., object], *arguments: object) -> Callable[[], None]:
        """Call ``work`` after ``delay`` seconds; return a function that cancels the call."""
        if self.is_stopped:
            return lambda: None

        def run() -> None:
            self._calls.pop(call, None)
            work(*arguments)

        def cancel() -> None:
            self._calls.pop(call, None)
            if call.active():
                call.cancel()

        call = self._clock.callLater(delay, run)
        self._calls[call] = None
        return cancel

    def every(self, period: float, work: Callable[[], object]) -> None:
        """Call ``work`` repeatedly, ``period`` seconds apart."""

        def again() -> None:
            self.later(period, again)
            work()

        self.later(period, again)

    def sleep(self, seconds: float) -> Deferred[None]:
        """Return a Deferred that fires after ``seconds``; it never fires if the node stops earlier."""
        woken: Deferred[None] = Deferred()
        self.later(seconds, woken.callback, None)
        return woken

    def fork(self, work: Coroutine[Any, Any, Any]) -> None:
        """Run ``work`` in the background; an ``EntangledError`` ends it silently, other errors are logged."""

        def ended(failure: Any) -> None:
            if failure.check(EntangledError) is None:
                self._log.failure("a background task of the node failed", failure)

        Deferred.fromCoroutine(work).addErrback(ended)

    def stop(self) -> None:
        """Cancel every timer."""
        self.is_stopped = True
        for call in self._calls:
            if call.active():
                call.cancel()
        self._calls.clear()


async def gather_until(enough: Callable[[list[Any]], bool], work: Iterable[Coroutine[Any, Any, Any]]) -> list[Any]:
    """Return the results of the coroutines ``work`` when ``enough(results)`` is true, or when all have ended.

    The remaining coroutines continue.  A coroutine that ends with an ``EntangledError`` gives no result.
    """
    results: list[Any] = []
    begun = list(work)
    left = len(begun)
    done: Deferred[None] = Deferred()

    def settle() -> None:
        if not done.called and (left == 0 or enough(results)):
            done.callback(None)

    def succeeded(result: Any) -> None:
        nonlocal left
        left -= 1
        results.append(result)
        settle()

    def failed(failure: Any) -> None:
        nonlocal left
        left -= 1
        settle()
        failure.trap(EntangledError)

    for coroutine in begun:
        Deferred.fromCoroutine(coroutine).addCallbacks(succeeded, failed)
    settle()
    await done
    return list(results)


async def run_limited(width: int, work: Iterable[Coroutine[Any, Any, Any]]) -> None:
    """Run all of ``work``, at most ``width`` at a time, ignoring each ``EntangledError``.

    ``work`` should be a generator, so that a coroutine is created only when it starts.
    """
    turns = iter(work)

    async def lane() -> None:
        for coroutine in turns:
            with suppress(EntangledError):
                await coroutine

    await gather_until(lambda _: False, [lane() for _ in range(width)])


async def gather_first(needed: int, work: Iterable[Coroutine[Any, Any, Any]]) -> list[Any]:
    """Return the first ``needed`` results of ``work``, or fewer if all coroutines have ended; others continue."""
    return await gather_until(lambda results: len(results) >= needed, work)
