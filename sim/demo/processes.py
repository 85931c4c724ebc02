"""Run the processes of a demonstration under Twisted's ``ProcessMonitor``.

The output of a process is written line by line to ``RUN_DIR/NAME.log`` and passed to a callback.  A process that ends
is restarted after ``RESTART_S``, so that the team notices the failure of a node.
"""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path
from typing import Any, TextIO

from twisted.internet.defer import Deferred
from twisted.internet.error import ProcessExitedAlready
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger
from twisted.runner.procmon import ProcessMonitor

TAIL_LINES = 12
RESTART_S = 30.0
"""Seconds before a process is restarted: longer than another robot needs to finish the task on a busy machine."""


class ProcessGroup:
    """Processes by name, started and ended together.

    :param reactor: starts the processes and provides the time
    :param run_dir: an existing folder for the logs
    :param on_line: called with the name of a process and each line of its output
    """

    log = Logger()

    def __init__(
        self, reactor: Any, run_dir: Path, on_line: Callable[[str, str], None] = lambda name, line: None
    ) -> None:
        self._clock = IReactorTime(reactor)
        self._run_dir = run_dir
        self._on_line = on_line
        self._logs: dict[str, TextIO] = {}
        self._tails: dict[str, deque[str]] = {}
        self._stopped: Deferred[None] | None = None
        monitor = ProcessMonitor(reactor)
        # With an infinite threshold the monitor regards every end as too early, and restarts after the delay set here.
        monitor.threshold = inf  # type: ignore[assignment]
        monitor.minRestartDelay = monitor.maxRestartDelay = RESTART_S  # type: ignore[assignment]
        monitor.killTime = 4
        monitor.log = Logger(namespace="team", observer=self._on_log_event)  # type: ignore[arg-type]
        self._monitor = monitor

    def add(self, name: str, arguments: Sequence[str], enter: Sequence[str] = ()) -> None:
        """Add a process, which starts immediately if the group runs. Raises ``KeyError`` if the name is taken.

        ``enter`` is a command prefix that has to exec the command (as ``nsenter`` does), so that signals reach the
        command.
        """
        if name not in self._logs:
            self._logs[name] = (self._run_dir / f"{name}.log").open("a", encoding="utf-8", buffering=1)
            self._tails[name] = deque(maxlen=TAIL_LINES)
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        self._monitor.addProcess(name, [*enter, *make_child_command(arguments)], env=environment)

    def start(self) -> None:
        """Start every process."""
        self._monitor.startService()

    def stop(self) -> Deferred[None]:
        """End every process, after four seconds with SIGKILL; fires when all have ended. May be called repeatedly."""
        done: Deferred[None] = Deferred()
        if self._stopped is None:
            self._stopped = done
            if self._monitor.running:
                self._monitor.stopService()
            self._check_ended()
        else:
            self._stopped.addCallback(lambda _: done.callback(None))
        return done

    def _check_ended(self) -> None:
        if self._monitor.protocols:
            self._clock.callLater(0.05, self._check_ended)
            return
        for log in self._logs.values():
            log.close()
        assert self._stopped is not None
        self._stopped.callback(None)

    def get_pid(self, name: str) -> int | None:
        """Return the process id; None while the process does not run."""
        protocol = self._monitor.protocols.get(name)
        return None if protocol is None or protocol.transport is None else protocol.transport.pid

    def list_ended(self) -> list[str]:
        """Return the names of the processes that do not run."""
        return [name for name in self._logs if self.get_pid(name) is None]

    def get_tail(self, name: str) -> list[str]:
        """Return the last lines of the process's output."""
        return list(self._tails[name])

    def kill(self, name: str) -> None:
        """Kill a process (SIGKILL); it is restarted after the delay.

        Raises ``KeyError`` if no such process runs.
        """
        protocol = self._monitor.protocols.get(name)
        if protocol is None or protocol.transport is None:
            raise KeyError(f"{name} does not run")
        try:
            protocol.transport.signalProcess("KILL")
        except ProcessExitedAlready:
            raise KeyError(f"{name} does not run") from None

    def _on_log_event(self, event: dict[str, Any]) -> None:
        name, line = event.get("tag"), event.get("line")
        if not isinstance(name, str) or not isinstance(line, str):
            failure = event.get("log_failure")
            if failure is not None:
                self.log.failure("cannot watch a process", failure=failure)
            return
        if not line:
            return  # the monitor adds an empty line at the end of the output
        self._tails[name].append(line)
        log = self._logs[name]
        if not log.closed:
            log.write(line + "\n")
        self._on_line(name, line)


def make_child_command(arguments: Sequence[str]) -> list[str]:
    """Return the command of a Python process with ``arguments`` that ends with this process (``parent_monitor``)."""
    return [sys.executable, "-m", "sim.demo.parent_monitor", *arguments]
