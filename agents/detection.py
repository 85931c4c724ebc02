"""Detection: the target is looked for in the newest picture only, and outside of the reactor's thread.

To decode a picture takes milliseconds to a second.  ``Run`` says where that happens: ``run_in_thread`` gives the
reactor's thread pool, and with virtual time ``run_now``, so that a run can be replayed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred, maybeDeferred
from twisted.internet.interfaces import IReactorThreads
from twisted.internet.threads import deferToThreadPool
from twisted.logger import Logger

Run = Callable[[Callable[[], Any]], Deferred[Any]]
"""Calls a function, now or in a thread; fires with its result in the reactor's thread."""


def run_now(function: Callable[[], Any]) -> Deferred[Any]:
    """Call the function at once."""
    return maybeDeferred(function)


def run_in_thread(clock: object) -> Run:
    """Use the thread pool of ``clock`` where that is a reactor with threads, else ``run_now``."""
    if not IReactorThreads.providedBy(clock):
        return run_now
    reactor: Any = clock
    return lambda function: deferToThreadPool(reactor, reactor.getThreadPool(), function)


class Detector:
    """Runs one detection at a time; of the pictures that wait meanwhile only the newest is kept."""

    _log = Logger()

    def __init__(self, run: Run = run_now) -> None:
        self.run = run
        self.dropped = 0
        """Pictures that gave way to a newer one."""
        self._is_running = False
        self._waiting: tuple[Callable[[], Any], Callable[[Any], None]] | None = None

    def detect(self, find: Callable[[], Any], found: Callable[[Any], None]) -> None:
        """Have ``find`` called, and ``found`` with its result; never, where a newer picture comes before its turn."""
        if self._is_running:
            self.dropped += self._waiting is not None
            self._waiting = (find, found)
            return
        self._is_running = True
        self.run(find).addCallback(found).addErrback(self._failed).addCallback(self._ended)

    def _failed(self, failure: Any) -> None:
        self._log.failure("a picture could not be searched", failure)

    def _ended(self, _: object) -> None:
        self._is_running = False
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            self.detect(*waiting)
