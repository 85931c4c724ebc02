"""The interface of a dead man's switch, and an implementation in memory for tests.

A driver reports the bytes that halt its robot, the end of the motion in force, and when the robot is at rest.  When
that end passes and no newer message has arrived, the switch halts the robot.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from twisted.internet.defer import Deferred, succeed

from drivers.link import Link


@dataclass(frozen=True)
class HaltCommand:
    """The bytes that halt a robot, as one complete command, and their destination.

    The destination is the open ``link``, or, if each command uses a new connection, the numeric ``address`` and port of
    a server.
    """

    data: bytes
    link: Link
    address: tuple[str, int] | None = None


class DeadManSwitch(Protocol):
    """A switch for one robot; no method blocks."""

    @property
    def halts(self) -> int:
        """The number of times that the switch has halted the robot."""

    def set_halt_command(self, command: HaltCommand) -> None:
        """Set the halt command; call this when a link opens or the command changes."""

    def arm(self, seconds: float) -> None:
        """Announce, before a motion is commanded, that it is in force for ``seconds`` from now."""

    def disarm(self) -> None:
        """Announce that a halt was sent: once the halt has left this process, no motion is in force."""

    def on_link_lost(self) -> None:
        """Announce that the link is lost."""

    def close(self) -> Deferred[None]:
        """End the switch after pending data has left; fires when all its resources are released."""


@dataclass
class MemoryDeadManSwitch:
    """A switch that only records its calls; ``seconds`` is None while no motion is in force."""

    halts: int = 0
    command: HaltCommand | None = None
    seconds: float | None = None
    is_closed: bool = False
    calls: list[str] = field(default_factory=list)

    def set_halt_command(self, command: HaltCommand) -> None:
        """Record the halt command."""
        self.command = command
        self.calls.append("guard")

    def arm(self, seconds: float) -> None:
        """Record the duration."""
        self.seconds = seconds
        self.calls.append("until")

    def disarm(self) -> None:
        """Record that no motion is in force."""
        self.seconds = None
        self.calls.append("rest")

    def on_link_lost(self) -> None:
        """Record the loss of the link."""
        self.command = None
        self.calls.append("leave")

    def close(self) -> Deferred[None]:
        """Record the end."""
        self.is_closed = True
        self.calls.append("close")
        return succeed(None)
