"""Search the newest camera picture for the target, outside the reactor's thread.

Decoding a picture takes milliseconds to a second.  ``run_in_thread`` decodes in the reactor's thread pool; in virtual
time ``run_now`` keeps runs reproducible.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred, maybeDeferred
from twisted.internet.interfaces import IReactorThreads
from twisted.internet.threads import deferToThreadPool
from twisted.logger import Logger

Executor = Callable[[Callable[[], Any]], Deferred[Any]]
"""Calls a function, immediately or in a thread; its Deferred fires with the result in the reactor's thread."""


def run_now(function: Callable[[], Any]) -> Deferred[Any]:
    """Call the function immediately."""
    return maybeDeferred(function)


def run_in_thread(clock: object) -> Executor:
    """Return an ``Executor`` with the thread pool of ``clock``, or ``run_now`` if the clock has no threads."""
    if not IReactorThreads.providedBy(clock):
        return run_now
    reactor: Any = clock
    return lambda function: deferToThreadPool(reactor, reactor.getThreadPool(), function)


class Detector:
    """Runs one detection at a time; only the newest waiting picture is kept."""

    _log = Logger()

    def __init__(self, run: Executor = run_now) -> None:
        self.run = run
        self.dropped = 0
        """Number of pictures that were replaced by a newer one."""
        self._is_running = False
        self._waiting: tuple[Callable[[], Any], Callable[[Any], None]] | None = None

    def detect(self, find: Callable[[], Any], found: Callable[[Any], None]) -> None:
        """Call ``find``, then ``found`` with its result, unless a newer picture arrives before ``find`` starts."""
        if self._is_running:
            self.dropped += self._waiting is not None
            self._waiting = (find, found)
            return
        self._is_running = True
        self.run(find).addCallback(found).addErrback(self._log_failure).addCallback(self._run_next)

    def _log_failure(self, failure: Any) -> None:
        self._log.failure("searching a picture failed", failure)

    def _run_next(self, _: object) -> None:
        self._is_running = False
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            self.detect(*waiting)
