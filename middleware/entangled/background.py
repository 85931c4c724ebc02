"""Background: the work of a node that nobody waits for, on one clock, and gone without a trace when the node stops."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Iterable
from contextlib import suppress
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime
from twisted.logger import Logger

from middleware.entangled.errors import EntangledError


def cancel(timer: IDelayedCall | None) -> None:
    """Cancel a timer that may be none, or over."""
    if timer is not None and timer.active():
        timer.cancel()


class Background:
    """Timers and coroutines of one node; after ``stop`` none of them runs."""

    _log = Logger()

    def __init__(self, clock: IReactorTime) -> None:
        self._clock = clock
        self._waiting: dict[IDelayedCall, None] = {}
        self.is_stopped = False

    def later(self, delay: float, work: Callable[..., object], *arguments: object) -> Callable[[], None]:
        """Call ``work`` after ``delay`` seconds; call what is returned to prevent it."""
        if self.is_stopped:
            return lambda: None

        def run() -> None:
            self._waiting.pop(call, None)
            work(*arguments)

        def cancel() -> None:
            self._waiting.pop(call, None)
            if call.active():
                call.cancel()

        call = self._clock.callLater(delay, run)
        self._waiting[call] = None
        return cancel

    def every(self, period: float, work: Callable[[], object]) -> None:
        """Call ``work`` again and again, ``period`` seconds apart."""

        def again() -> None:
            self.later(period, again)
            work()

        self.later(period, again)

    def sleep(self, seconds: float) -> Deferred[None]:
        """Fire after ``seconds``; never where the node stops before."""
        woken: Deferred[None] = Deferred()
        self.later(seconds, woken.callback, None)
        return woken

    def fork(self, work: Coroutine[Any, Any, Any]) -> None:
        """Let ``work`` run by itself; the weather, a refusal and a stopped node end it quietly."""

        def ended(failure: Any) -> None:
            if failure.check(EntangledError) is None:
                self._log.failure("in the background of a node", failure)

        Deferred.fromCoroutine(work).addErrback(ended)

    def stop(self) -> None:
        """Cancel every timer."""
        self.is_stopped = True
        for call in self._waiting:
            if call.active():
                call.cancel()
        self._waiting.clear()


async def until(enough: Callable[[list[Any]], bool], work: Iterable[Coroutine[Any, Any, Any]]) -> list[Any]:
    """The results of ``work`` as soon as they are ``enough``, or when all of it has ended; the rest goes on.

    What ends in an ``EntangledError`` gives no result.
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


async def paced(width: int, work: Iterable[Coroutine[Any, Any, Any]]) -> None:
    """Run all of ``work``, at most ``width`` at a time; what ends in an ``EntangledError`` is let be.

    ``work`` is best a generator, so that what is not begun yet costs nothing.
    """
    turns = iter(work)

    async def lane() -> None:
        for coroutine in turns:
            with suppress(EntangledError):
                await coroutine

    await until(lambda _: False, [lane() for _ in range(width)])


async def first(needed: int, work: Iterable[Coroutine[Any, Any, Any]]) -> list[Any]:
    """The results of the first ``needed`` of ``work`` that succeed, fewer when all have ended; the others go on."""
    return await until(lambda results: len(results) >= needed, work)
