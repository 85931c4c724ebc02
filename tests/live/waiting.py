"""Wait for conditions on the running reactor, in tests that are coroutines."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet import reactor
from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.internet.task import deferLater

CLOCK = IReactorTime(reactor)
STEP_S = 0.005


def wait(seconds: float) -> Deferred[None]:
    """Return a Deferred that fires after ``seconds``."""
    return deferLater(CLOCK, seconds, lambda: None)


async def until(is_so: Callable[[], Any], seconds: float = 20.0) -> None:
    """Return as soon as ``is_so`` is true; fail after ``seconds``."""
    end = CLOCK.seconds() + seconds
    while not is_so():
        if CLOCK.seconds() > end:
            raise AssertionError(f"not so within {seconds} s")
        await wait(STEP_S)
