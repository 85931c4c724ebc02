"""Record the events of a run in their order, for the checker; events are only appended."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Iterator

from sim.team.event import Answered, Asked, Event, Unanswered


class History:
    """The events of one run; ``seconds`` returns the time of the simulator's clock.

    Clients record their requests and answers; ``sim.team.checker`` checks these afterwards. A request without an
    answer remains open: it may have been executed.
    """

    def __init__(self, seconds: Callable[[], float]) -> None:
        self.events: list[Event] = []
        self._seconds = seconds
        self._request_count = 0

    def __iter__(self) -> Iterator[Event]:
        return iter(self.events)

    def __len__(self) -> int:
        return len(self.events)

    def record(self, kind: Callable[..., Event], *facts: object) -> None:
        """Append an event of the class ``kind``."""
        self.events.append(kind(self._seconds(), *facts))

    def record_request(self, client: Hashable, what: str, subject: Hashable, argument: object = None) -> int:
        """Append a client's request; return the number of the request, for its answer."""
        self._request_count += 1
        self.events.append(Asked(self._seconds(), self._request_count, client, what, subject, argument))
        return self._request_count

    def record_answer(self, number: int, result: object = None) -> None:
        """Append the answer to a request."""
        self.events.append(Answered(self._seconds(), number, result))

    def record_failure(self, number: int, why: object, is_unavailable: bool = False) -> None:
        """Append that the client gave up; the outcome of the request is unknown."""
        self.events.append(Unanswered(self._seconds(), number, str(why), is_unavailable))

    def digest(self) -> str:
        """Return a hash of all events; it is the same for runs of the same seed."""
        hashed = hashlib.blake2b(digest_size=16)
        for event in self.events:
            hashed.update(repr(event).encode())
        return hashed.hexdigest()
