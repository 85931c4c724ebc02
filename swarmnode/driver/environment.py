"""Environment of the robot commands: clock, links and terminal of this machine.

The links, and the log messages of drivers, show why a robot is not reachable.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, Protocol

from twisted.internet.defer import Deferred, maybeDeferred
from twisted.logger import ILogObserver, LogEvent, LogLevel, formatEvent, globalLogPublisher
from twisted.python.failure import Failure
from zope.interface import implementer

from swarmnode.driver.drive import Terminal

SERIAL_PATTERN = re.compile(r".*[/\\].*|COM\d+", re.DOTALL)
"""A serial device is a path or a Windows port; everything else is a network address."""


class CommandEnvironment(Protocol):
    """The environment of a command."""

    @property
    def clock(self) -> Any:
        """The reactor, or a replacement for it."""

    def make_connector(self, is_moving: bool) -> tuple[Any, Callable[[], list[str]]]:
        """Return the connector for a driver (None: the driver's default), and a function that lists link problems."""

    def open_terminal(self) -> Terminal:
        """Return the terminal; raises ``UsageError`` if there is none."""

    def run(self, work: Callable[[], Deferred[Any]], end: Callable[[], Any]) -> Any:
        """Run until ``work`` has fired, and return its value; ``end`` is called on an interrupt."""


class RealEnvironment:
    """This machine, with Twisted's reactor."""

    @property
    def clock(self) -> Any:
        """The reactor."""
        from twisted.internet import reactor  # importing it installs the reactor

        return reactor

    def make_connector(self, is_moving: bool) -> tuple[Any, Callable[[], list[str]]]:
        """Return a connector that records problems; None if the robot will move.

        Only the driver's default links ensure that the robot is stopped.
        """
        if is_moving:
            return None, list
        from drivers.link import TcpConnector
        from drivers.serial import SerialConnector

        witnessed = RecordingConnector(TcpConnector(), SerialConnector())
        return witnessed, witnessed.list_problems

    def open_terminal(self) -> Terminal:
        """Return the terminal of this process."""
        from swarmnode.driver.terminal import open_terminal

        return open_terminal(self.clock)

    def run(self, work: Callable[[], Deferred[Any]], end: Callable[[], Any]) -> Any:
        """Run the reactor until ``work`` has fired; on Ctrl-C the robot stops first."""
        reactor, results, interrupted = self.clock, list[Any](), list[bool]()

        def finish(value: Any) -> None:
            results.append(value)
            if not interrupted:
                reactor.stop()

        def begin() -> None:
            maybeDeferred(work).addBoth(finish)

        def on_shutdown() -> Any:
            # The reactor waits for the result: the robot stops and is disconnected before the process ends.
            if results:
                return None
            interrupted.append(True)
            return end()

        reactor.addSystemEventTrigger("before", "shutdown", on_shutdown)
        reactor.callWhenRunning(begin)
        reactor.run()
        value = results[0] if results else 1
        if isinstance(value, Failure):
            value.raiseException()
        return value


class RecordingConnector:
    """Opens real links over TCP or serial devices, and records the newest error of each link."""

    def __init__(self, tcp: Any, serial: Any) -> None:
        self._tcp = tcp
        self._serial = serial
        self._reconnectors: dict[str, Any] = {}

    def connect(self, host: str, port: int, client: Any) -> Any:
        """Keep ``client`` connected, as the wrapped connector does."""
        is_serial = SERIAL_PATTERN.fullmatch(host) is not None
        reconnector = (self._serial if is_serial else self._tcp).connect(host, port, client)
        # Keep only the newest link to each address: a robot with an HTTP interface has a link for each request.
        self._reconnectors[host if is_serial else f"{host}:{port}"] = reconnector
        return reconnector

    def list_problems(self) -> list[str]:
        """Return the links that are not open now, each with the reason."""
        results = {place: str(getattr(reconnector, "problem", "")) for place, reconnector in self._reconnectors.items()}
        return [f"{place}: {problem}" for place, problem in results.items() if problem]


@implementer(ILogObserver)
class WarningCollector:
    """Log observer that collects the warnings of drivers, each once."""

    def __init__(self) -> None:
        self.warnings: list[str] = []
        globalLogPublisher.addObserver(self)

    def __call__(self, event: LogEvent) -> None:
        """Process a log event."""
        level = event.get("log_level")
        if level is None or level < LogLevel.warn or not str(event.get("log_namespace", "")).startswith("drivers."):
            return
        line = " ".join(formatEvent(event).split())
        if line and line not in self.warnings:
            self.warnings.append(line)

    def close(self) -> None:
        """Stop observing."""
        globalLogPublisher.removeObserver(self)
