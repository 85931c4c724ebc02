"""Channel: the two pipes between a node and the process of one module, as the node sees them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol


class Gone(Exception):
    """The process has ended, or said what no answer can be; the text says which."""


class Channel(Protocol):
    """A running process; ``receive`` and ``send`` raise ``Gone``."""

    def send(self, message: bytes) -> None:
        """Send a message; the next ``receive`` sends the rest that the pipe does not take now."""

    @property
    def is_behind(self) -> bool:
        """Whether something is left to be sent."""

    def receive(self, within_s: float) -> list[bytes]:
        """The received messages; if there is none yet, wait for one at most ``within_s`` seconds."""

    def end(self) -> None:
        """End the process at once; may be called again."""


Spawn = Callable[[], Channel]
"""Starts a process that has no module yet."""
