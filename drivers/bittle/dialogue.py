"""Dialogue: commands matched to the lines that the robot answers with; it knows no link.

The robot does commands in their order, so a command may leave before the one before it is answered: a stop never waits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from drivers.bittle.codec import is_end, unknown_of
from drivers.errors import NoReply, RobotError, Unsupported

OVERFLOW = "OVF"
"""What the robot says of a command that is longer than it can take."""
MAX_LINES = 40
"""No command has more lines for an answer; further ones are dropped."""


@dataclass(eq=False)
class _Question:
    command: bytes
    token: str
    answered: Deferred[list[str]] = field(default_factory=Deferred)
    lines: list[str] = field(default_factory=list)
    timer: Any = None


class Dialogue:
    """Asks with ``send``; each answer, or ``NoReply``, comes by the Deferred of its question."""

    def __init__(self, clock: IReactorTime, send: Callable[[bytes], None]) -> None:
        self._clock = clock
        self._send = send
        self._open: list[_Question] = []

    def ask(self, command: bytes, patience: float) -> Deferred[list[str]]:
        """Send ``command``; fires with the lines before its token, or fails with ``NoReply`` or ``Unsupported``."""
        question = _Question(command, chr(command[0]))
        question.timer = self._clock.callLater(patience, self._on_late, question)
        self._open.append(question)
        self._send(command)
        return question.answered

    def heard(self, line: str) -> None:
        """Take one line from the robot."""
        if not self._open:
            return
        if line == OVERFLOW:
            self._fail(self._open[0], RobotError(f"the robot takes no command so long: {self._open[0].command!r}"))
            return
        name = unknown_of(line)
        if name is not None:
            for question in self._open:
                if question.command[1:].strip() == name.encode():
                    self._fail(question, Unsupported(f"the robot knows no skill {name!r}"))
                    return
        for place, question in enumerate(self._open):
            # A skill is answered with its name first, which tells those apart whose token is the same.
            if place and question.token == "k" and question.command[1:].strip() == line.encode():
                self._pass(place)
                break
        # Before the end of a rest, the robot says that its gyroscope is off, with the token of that.
        is_aside = self._open[0].token == "d" and is_end(line, "g")
        if not is_aside:
            for place, question in enumerate(self._open):
                if is_end(line, question.token):
                    self._pass(place)
                    if self._take(question):
                        question.answered.callback(question.lines)
                    return
        if self._open and len(self._open[0].lines) < MAX_LINES:
            self._open[0].lines.append(line)

    def end(self, error: Exception) -> None:
        """Fail what has not been answered."""
        for question in list(self._open):
            self._fail(question, error)

    def _pass(self, place: int) -> None:
        for passed in self._open[:place]:
            self._fail(passed, NoReply("the robot has gone on without an answer"))

    def _on_late(self, question: _Question) -> None:
        self._fail(question, NoReply(f"no answer to {question.command!r}"))

    def _fail(self, question: _Question, error: Exception) -> None:
        if self._take(question):
            question.answered.errback(error)

    def _take(self, question: _Question) -> bool:
        """Whether it was open still: who is told of one failure may end all others."""
        if question not in self._open:
            return False
        self._open.remove(question)
        if question.timer.active():
            question.timer.cancel()
        return True
