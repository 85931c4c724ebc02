"""Match commands to the lines of the robot's answers.

The robot executes commands in order, so a command can be sent before the previous command is answered. In particular,
a stop is always sent immediately.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from drivers.bittle.codec import is_end, parse_unknown_skill
from drivers.errors import NoReply, RobotError, Unsupported

OVERFLOW = "OVF"
"""The robot's reply to a command that is too long."""
MAX_ANSWER_LINES = 40
"""Maximum number of stored lines of one answer; further lines are dropped."""


@dataclass(eq=False)
class _PendingCommand:
    command: bytes
    token: str
    done: Deferred[list[str]] = field(default_factory=Deferred)
    lines: list[str] = field(default_factory=list)
    timer: Any = None


class RequestTable:
    """Sends commands with ``send``; the Deferred of each command fires with its answer or fails with ``NoReply``."""

    def __init__(self, clock: IReactorTime, send: Callable[[bytes], None]) -> None:
        self._clock = clock
        self._send = send
        self._pending: list[_PendingCommand] = []

    def request(self, command: bytes, patience: float) -> Deferred[list[str]]:
        """Send ``command``; fires with the lines before its token, or fails with ``NoReply`` or ``Unsupported``.

        ``patience`` is the longest wait in seconds.
        """
        pending = _PendingCommand(command, chr(command[0]))
        pending.timer = self._clock.callLater(patience, self._on_timeout, pending)
        self._pending.append(pending)
        self._send(command)
        return pending.done

    def process_line(self, line: str) -> None:
        """Process one line from the robot."""
        if not self._pending:
            return
        if line == OVERFLOW:
            first = self._pending[0]
            self._fail(first, RobotError(f"the command is too long for the robot: {first.command!r}"))
            return
        name = parse_unknown_skill(line)
        if name is not None:
            for pending in self._pending:
                if pending.command[1:].strip() == name.encode():
                    self._fail(pending, Unsupported(f"the robot knows no skill {name!r}"))
                    return
        for place, pending in enumerate(self._pending):
            # The answer to a skill starts with the skill's name, which distinguishes commands with the same token.
            if place and pending.token == "k" and pending.command[1:].strip() == line.encode():
                self._skip_to(place)
                break
        # Before the robot answers the rest command, it reports that the gyroscope is off, with the gyroscope's token.
        is_gyroscope_report = self._pending[0].token == "d" and is_end(line, "g")
        if not is_gyroscope_report:
            for place, pending in enumerate(self._pending):
                if is_end(line, pending.token):
                    self._skip_to(place)
                    if self._remove(pending):
                        pending.done.callback(pending.lines)
                    return
        if self._pending and len(self._pending[0].lines) < MAX_ANSWER_LINES:
            self._pending[0].lines.append(line)

    def fail_all(self, error: Exception) -> None:
        """Fail all unanswered commands with ``error``."""
        for pending in list(self._pending):
            self._fail(pending, error)

    def _skip_to(self, place: int) -> None:
        for skipped in self._pending[:place]:
            self._fail(skipped, NoReply("the robot answered a later command first"))

    def _on_timeout(self, pending: _PendingCommand) -> None:
        self._fail(pending, NoReply(f"no answer to {pending.command!r}"))

    def _fail(self, pending: _PendingCommand, error: Exception) -> None:
        if self._remove(pending):
            pending.done.errback(error)

    def _remove(self, pending: _PendingCommand) -> bool:
        """Remove a pending command; return False if the errback of another command has already removed it."""
        if pending not in self._pending:
            return False
        self._pending.remove(pending)
        if pending.timer.active():
            pending.timer.cancel()
        return True
