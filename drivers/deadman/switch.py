"""The interface of a dead man's switch, and an implementation in memory for tests.

A driver reports the bytes that halt its robot, the end of the motion in force, and when the robot is at rest.  The
switch halts the robot when that time passes without a newer message.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from twisted.internet.defer import Deferred, succeed

from drivers.link import Link


@dataclass(frozen=True)
class LastWord:
    """The bytes that halt a robot, as one complete command, and their destination.

    The destination is the open ``link``, or, if each command uses a new connection, the numeric ``address`` and port of
    a server.
    """

    halt: bytes
    link: Link
    address: tuple[str, int] | None = None


class DeadMan(Protocol):
    """A switch for one robot; no method blocks."""

    @property
    def halts(self) -> int:
        """The number of times that it has halted the robot."""

    def guard(self, word: LastWord) -> None:
        """Set the halt command; call this when a link opens or the command changes."""

    def until(self, seconds: float) -> None:
        """Announce, before a motion is commanded, that it is in force for ``seconds`` from now."""

    def rest(self) -> None:
        """Announce that a halt was sent: nothing is in force once it has left this process."""

    def leave(self) -> None:
        """Announce that the link is lost."""

    def close(self) -> Deferred[None]:
        """End the switch after pending data has left; fires when all its resources are released."""


@dataclass
class MemoryDeadMan:
    """A switch that only records its calls; ``seconds`` is None while nothing is in force."""

    halts: int = 0
    word: LastWord | None = None
    seconds: float | None = None
    is_closed: bool = False
    told: list[str] = field(default_factory=list)

    def guard(self, word: LastWord) -> None:
        """Record the halt command."""
        self.word = word
        self.told.append("guard")

    def until(self, seconds: float) -> None:
        """Record the duration."""
        self.seconds = seconds
        self.told.append("until")

    def rest(self) -> None:
        """Record that nothing is in force."""
        self.seconds = None
        self.told.append("rest")

    def leave(self) -> None:
        """Record that there is no link."""
        self.word = None
        self.told.append("leave")

    def close(self) -> Deferred[None]:
        """Record the end."""
        self.is_closed = True
        self.told.append("close")
        return succeed(None)
