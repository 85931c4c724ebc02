"""Listeners: the functions that an object calls at one kind of event."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, ParamSpec

P = ParamSpec("P")


class Listeners(Generic[P]):
    """The listeners of one kind of event, called in the order in which they were added.

    Only the owner of the event calls it.  ``add`` and ``remove`` replace the tuple, so that a notification that is
    under way reaches those who listened when it began.  What a listener raises goes to the owner.
    """

    __slots__ = ("_all",)

    def __init__(self) -> None:
        self._all: tuple[Callable[P, object], ...] = ()

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> None:
        """Notify everybody."""
        for listener in self._all:
            listener(*args, **kwargs)

    def add(self, listener: Callable[P, object]) -> None:
        """Notify ``listener`` of each event from now on."""
        self._all = (*self._all, listener)
