"""A timer with at most one pending call."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet.interfaces import IReactorTime


class Timer:
    """A call on ``clock``; setting it again cancels the pending call."""

    def __init__(self, clock: IReactorTime) -> None:
        self._clock = clock
        self._call: Any = None

    @property
    def is_set(self) -> bool:
        """Whether a call is pending."""
        return self._call is not None and bool(self._call.active())

    def set(self, seconds: float, call: Callable[..., object], *arguments: object) -> None:
        """Call ``call`` after ``seconds``."""
        self.cancel()
        self._call = self._clock.callLater(seconds, call, *arguments)

    def cancel(self) -> None:
        """Cancel the pending call, if there is one."""
        call, self._call = self._call, None
        if call is not None and call.active():
            call.cancel()
