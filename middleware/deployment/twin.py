"""Twin: the channel of a module that runs in this process, through the same messages; for simulators and tests."""

from __future__ import annotations

from collections.abc import Mapping

from middleware.deployment.channel import Gone
from middleware.deployment.frame import MAX_ANSWER, MAX_QUESTION, BadFrame, Splitter
from middleware.deployment.host import Host, Kind


class MemoryChannel:
    """A channel whose other end is in this process."""

    is_behind = False

    def __init__(self, kinds: Mapping[str, Kind]) -> None:
        self._host: Host | None = Host(kinds, lambda kind, source: ["simulated"])
        self._questions = Splitter(MAX_QUESTION)
        self._answers = Splitter(MAX_ANSWER)
        self._ready: list[bytes] = []

    def send(self, message: bytes) -> None:
        """Have the question answered at once."""
        if self._host is None:
            raise Gone("its process has ended")
        try:
            for question in self._questions.feed(message):
                self._ready += self._answers.feed(self._host.answer(question))
        except BadFrame as error:
            raise Gone(f"its answer {error}") from error

    def receive(self, within_s: float) -> list[bytes]:
        """The answers since the last time."""
        if self._host is None:
            raise Gone("its process has ended")
        ready, self._ready = self._ready, []
        return ready

    def end(self) -> None:
        """Forget the module."""
        self._host = None
