"""Tally: the datagrams that carry bids through one node; pure.

Nodes beat, ping and answer all the time, often in step, so what an auction costs does not show in what is sent in all.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred
from twisted.python.failure import Failure

from middleware.entangled.contact import Contact
from middleware.entangled.errors import Refused
from middleware.entangled.wire.endpoint import Endpoint

MARK, HEAD = b"bid.", 64
"""What the name of a method that carries bids begins with, and in how many bytes of a message it stands."""


class Tally:
    """A ``dissemination.Wire`` over ``endpoint`` that counts what passes; ``sent`` and ``received`` are datagrams."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        self.sent = self.received = self.bytes = 0
        # A question goes out as often as it takes; how often only the asker below knows.
        asker = endpoint._asker
        asker._send = self._counted(asker._send)

    @property
    def handled(self) -> int:
        """Datagrams sent and received."""
        return self.sent + self.received

    def ask(
        self, contact: Contact, method: str, *arguments: object, timeout: float | None = None, changes: bool = False
    ) -> Deferred[Any]:
        """Ask a peer; its answer is one more datagram."""
        asked = self._endpoint.ask(contact, method, *arguments, timeout=timeout, changes=changes)
        return asked.addCallbacks(self._answered, self._refused)

    def tell(self, contact: Contact, method: str, *arguments: object) -> None:
        """Tell a peer."""
        self._endpoint.tell(contact, method, *arguments)

    def asked(self, is_answered: bool = True) -> None:
        """Take note of a question, which comes as often as it arrives, and of its answer."""
        self.received += 1
        self.sent += is_answered

    def _answered(self, answer: Any) -> Any:
        self.received += 1
        return answer

    def _refused(self, failure: Failure) -> Failure:
        self.received += failure.check(Refused) is not None
        return failure

    def _counted(self, send: Callable[..., None]) -> Callable[..., None]:
        def counted(session: Any, message: bytes) -> None:
            if MARK in message[:HEAD]:
                self.sent += 1
                self.bytes += len(message)
            send(session, message)

        return counted
