"""Channel: the two pipes between a node and the process of one module, and a twin of them in memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from middleware.deployment.frame import MAX_ANSWER, MAX_QUESTION, BadFrame, Splitter
from middleware.deployment.host import Host, Kind


class Gone(Exception):
    """The process has ended, or said what no answer can be; the text says which."""


class Channel(Protocol):
    """A running process; ``receive`` and ``send`` raise ``Gone``."""

    def send(self, message: bytes) -> None:
        """Send a message; what the process does not take at once is sent by the next ``receive``."""

    @property
    def is_behind(self) -> bool:
        """Whether something is left to be sent."""

    def receive(self, within_s: float) -> list[bytes]:
        """The messages that came; where there is none yet, waits for one at most ``within_s`` seconds."""

    def end(self) -> None:
        """End the process at once; may be called again."""


Spawn = Callable[[], Channel]
"""Starts a process that has no module yet."""


class MemoryChannel:
    """The twin of a process: the module runs in this one, through the same messages.  For simulators and tests."""

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
