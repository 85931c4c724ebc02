"""An environment for ``swarm driver`` in memory: virtual time, an emulated robot and scripted keys."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.task import Clock
from twisted.python.failure import Failure

from swarmnode.driver.command import main

STEP_S = 0.005
PATIENCE_S = 60.0


class ScriptedTerminal:
    """A terminal on which ``keys`` are pressed, each at its time after the start; it records the output."""

    def __init__(self, clock: Clock, keys: Sequence[tuple[float, str]]) -> None:
        self.lines: list[tuple[float, str]] = []
        self.said: list[str] = []
        self.closed = 0
        self._clock = clock
        self._keys = keys

    def start(self, pressed: Callable[[str], None]) -> None:
        for seconds, key in self._keys:
            self._clock.callLater(seconds, pressed, key)

    def show_status(self, text: str) -> None:
        self.lines.append((self._clock.seconds(), text))

    def write_line(self, text: str) -> None:
        self.said.append(text)

    def close(self) -> None:
        self.closed += 1


class MemoryEnvironment:
    """An environment in memory; each step of the clock calls ``pass_time``, which can move an emulated robot."""

    def __init__(self, clock: Clock, connector: Any, pass_time: Callable[[float], None] = lambda _: None) -> None:
        self.clock = clock
        self.keys: list[tuple[float, str]] = []
        self.problems: list[str] = []
        self.interrupted_at: float | None = None
        self.terminals: list[ScriptedTerminal] = []
        self._connector = connector
        self._pass_time = pass_time

    def make_connector(self, is_moving: bool) -> tuple[Any, Callable[[], list[str]]]:
        return self._connector, lambda: self.problems

    def open_terminal(self) -> ScriptedTerminal:
        self.terminals.append(ScriptedTerminal(self.clock, self.keys))
        return self.terminals[-1]

    def run(self, work: Callable[[], Deferred[Any]], end: Callable[[], Any]) -> Any:
        """Advance the clock until ``work`` has fired."""
        told: list[Any] = []
        work().addBoth(told.append)
        for _ in range(round(PATIENCE_S / STEP_S)):
            if told:
                break
            self.clock.advance(STEP_S)
            self._pass_time(STEP_S)
            if self.interrupted_at is not None and self.clock.seconds() >= self.interrupted_at:
                self.interrupted_at = None
                end()
        if not told:
            raise AssertionError("the command does not end")
        if isinstance(told[0], Failure):
            told[0].raiseException()
        return told[0]

    def swarm_driver(self, line: str) -> tuple[int, str, str]:
        """Run ``swarm driver LINE``; return exit code, standard output and standard error."""
        output, complaint = io.StringIO(), io.StringIO()
        with contextlib.redirect_stderr(complaint):
            code = main(line.split(), output, self)
        return code, output.getvalue(), complaint.getvalue()
