"""Register and call the listeners of an event."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, ParamSpec

P = ParamSpec("P")


class Listeners(Generic[P]):
    """The listeners of one event, called in the order in which they were added.

    Only the owner of the event calls this object.  A listener that is added during a notification is called from the
    next notification on.  An exception of a listener propagates to the owner.
    """

    __slots__ = ("_all",)

    def __init__(self) -> None:
        self._all: tuple[Callable[P, object], ...] = ()

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> None:
        """Call all listeners."""
        for listener in self._all:
            listener(*args, **kwargs)

    def add(self, listener: Callable[P, object]) -> None:
        """Call ``listener`` at each event from now on."""
        self._all = (*self._all, listener)
