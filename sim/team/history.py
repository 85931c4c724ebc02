"""History: everything that happened in a run, in its order; it is only ever added to, and judges nothing."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Iterator

from sim.team.event import Answered, Asked, Event, Unanswered


class History:
    """The events of one run; ``seconds`` tells the moment on the clock of its world.

    Who acts writes down what it asked for and what it got; ``sim.team.checker`` judges it afterwards.  What was asked
    and never answered may have been done: it stays open.
    """

    def __init__(self, seconds: Callable[[], float]) -> None:
        self.events: list[Event] = []
        self._seconds = seconds
        self._asked = 0

    def __iter__(self) -> Iterator[Event]:
        return iter(self.events)

    def __len__(self) -> int:
        return len(self.events)

    def note(self, kind: Callable[..., Event], *facts: object) -> None:
        """Something of that ``kind`` happens now."""
        self.events.append(kind(self._seconds(), *facts))

    def asked(self, client: Hashable, what: str, subject: Hashable, argument: object = None) -> int:
        """A client asks; the number under which to say what came of it."""
        self._asked += 1
        self.events.append(Asked(self._seconds(), self._asked, client, what, subject, argument))
        return self._asked

    def answered(self, number: int, result: object = None) -> None:
        """What was asked is done."""
        self.events.append(Answered(self._seconds(), number, result))

    def unanswered(self, number: int, why: object, is_unavailable: bool = False) -> None:
        """The client gave up: it is not known what came of it."""
        self.events.append(Unanswered(self._seconds(), number, str(why), is_unavailable))

    def digest(self) -> str:
        """A hash over all events; runs of the same seed have the same."""
        hashed = hashlib.blake2b(digest_size=16)
        for event in self.events:
            hashed.update(repr(event).encode())
        return hashed.hexdigest()
