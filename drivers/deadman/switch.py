"""Switch: what a driver holds of its dead man's switch, and the twin of it in memory.

A driver says which bytes halt its robot, until when a motion is in force, and when the robot is at rest.  Whoever
keeps the switch halts the robot when the time is over and no newer word has come.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from twisted.internet.defer import Deferred, succeed

from drivers.link import Link


@dataclass(frozen=True)
class LastWord:
    """The bytes that halt a robot, whole, and where they go.

    That is the open ``link`` itself, or, where each command has a connection of its own, the numeric ``address`` and
    port of a server.
    """

    halt: bytes
    link: Link
    address: tuple[str, int] | None = None


class DeadMan(Protocol):
    """A switch for one robot; nothing here blocks."""

    @property
    def halts(self) -> int:
        """How often it has halted the robot."""

    def guard(self, word: LastWord) -> None:
        """Halt the robot by this from now on: there is a link."""

    def until(self, seconds: float) -> None:
        """Learn, before a motion is commanded, that it is in force for so long from now."""

    def rest(self) -> None:
        """Learn that a halt has just been sent, so that nothing is in force once it has left."""

    def leave(self) -> None:
        """Learn that the link is gone."""

    def close(self) -> Deferred[None]:
        """End, once what was sent has left; fires when nothing is left of it."""


@dataclass
class MemoryDeadMan:
    """A switch that halts nothing, and keeps what it was told: ``seconds`` is None while nothing is in force."""

    halts: int = 0
    word: LastWord | None = None
    seconds: float | None = None
    is_closed: bool = False
    told: list[str] = field(default_factory=list)

    def guard(self, word: LastWord) -> None:
        """Keep the word."""
        self.word = word
        self.told.append("guard")

    def until(self, seconds: float) -> None:
        """Keep how long."""
        self.seconds = seconds
        self.told.append("until")

    def rest(self) -> None:
        """Keep that nothing is in force."""
        self.seconds = None
        self.told.append("rest")

    def leave(self) -> None:
        """Keep that there is no link."""
        self.word = None
        self.told.append("leave")

    def close(self) -> Deferred[None]:
        """Keep that it ended."""
        self.is_closed = True
        self.told.append("close")
        return succeed(None)
