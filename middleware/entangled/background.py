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


class _Chore:
    """Work that waits for its moment; with a ``period`` it is done again and again."""

    __slots__ = ("_chores", "call", "_work", "_arguments", "_period")

    def __init__(
        self, chores: Background, work: Callable[..., object], arguments: tuple[object, ...], period: float = 0.0
    ) -> None:
        self._chores = chores
        self._work = work
        self._arguments = arguments
        self._period = period
        self.call: IDelayedCall | None = None

    def run(self) -> None:
        """Do it; only the clock calls this."""
        if self._period:
            self._chores._wait(self, self._period)
        else:
            self._chores._waiting.pop(self, None)
        self._work(*self._arguments)

    def cancel(self) -> None:
        """Prevent it, where it has not been done."""
        self._chores._waiting.pop(self, None)
        cancel(self.call)


class Background:
    """Timers and coroutines of one node; after ``stop`` none of them runs."""

    _log = Logger()

    def __init__(self, clock: IReactorTime) -> None:
        self._clock = clock
        self._waiting: dict[_Chore, None] = {}
        self.is_stopped = False

    def later(self, delay: float, work: Callable[..., object], *arguments: object) -> Callable[[], None]:
        """Call ``work`` after ``delay`` seconds; call what is returned to prevent it."""
        chore = _Chore(self, work, arguments)
        self._wait(chore, delay)
        return chore.cancel

    def every(self, period: float, work: Callable[[], object]) -> None:
        """Call ``work`` again and again, ``period`` seconds apart."""
        self._wait(_Chore(self, work, (), period), period)

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
        for chore in list(self._waiting):
            chore.cancel()

    def _wait(self, chore: _Chore, delay: float) -> None:
        if not self.is_stopped:
            chore.call = self._clock.callLater(delay, chore.run)
            self._waiting[chore] = None


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
