"""Ground: what a command on a robot stands on: the clock, the links, the terminal; here those of this machine.

Its links, and the log of drivers, tell what keeps a robot from being reached.
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

SERIAL = re.compile(r".*[/\\].*|COM\d+", re.DOTALL)
"""A serial device is a path, or a port of Windows; all else is an address in a network."""


class Ground(Protocol):
    """Where a command meets the world."""

    @property
    def clock(self) -> Any:
        """The reactor, or a clock in its place."""

    def connector(self, is_moving: bool) -> tuple[Any, Callable[[], list[str]]]:
        """What opens the links of a driver (None: whatever it opens by itself), and what is wrong with them."""

    def terminal(self) -> Terminal:
        """The terminal; raises ``UsageError`` where there is none."""

    def run(self, work: Callable[[], Deferred[Any]], end: Callable[[], Any]) -> Any:
        """Run until ``work`` has fired, and return its value; ``end`` is called where somebody interrupts it."""


class RealGround:
    """This machine, on Twisted's reactor."""

    @property
    def clock(self) -> Any:
        """The reactor."""
        from twisted.internet import reactor  # importing it installs it

        return reactor

    def connector(self, is_moving: bool) -> tuple[Any, Callable[[], list[str]]]:
        """Links that tell why they are not open; who moves a robot gets those that its driver trusts its stop to."""
        if is_moving:
            return None, list
        from drivers.link import TcpConnector
        from drivers.serial import SerialConnector

        witnessed = WitnessedConnector(TcpConnector(), SerialConnector())
        return witnessed, witnessed.problems

    def terminal(self) -> Terminal:
        """The terminal that this process runs in."""
        from swarmnode.driver.terminal import real_terminal

        return real_terminal(self.clock)

    def run(self, work: Callable[[], Deferred[Any]], end: Callable[[], Any]) -> Any:
        """Run the reactor until ``work`` has fired; Ctrl-C ends it in order, so that the robot stands."""
        reactor, told, interrupted = self.clock, list[Any](), list[bool]()

        def finish(value: Any) -> None:
            told.append(value)
            if not interrupted:
                reactor.stop()

        def begin() -> None:
            maybeDeferred(work).addBoth(finish)

        def on_shutdown() -> Any:
            # The reactor waits for what this returns: the robot stands and is let go before the process ends.
            if told:
                return None
            interrupted.append(True)
            return end()

        reactor.addSystemEventTrigger("before", "shutdown", on_shutdown)
        reactor.callWhenRunning(begin)
        reactor.run()
        value = told[0] if told else 1
        if isinstance(value, Failure):
            value.raiseException()
        return value


class WitnessedConnector:
    """Opens real links, over TCP or serial devices, and remembers each line for what it says is wrong."""

    def __init__(self, tcp: Any, serial: Any) -> None:
        self._tcp = tcp
        self._serial = serial
        self._lines: dict[str, Any] = {}

    def call(self, host: str, port: int, caller: Any) -> Any:
        """Keep ``caller`` connected, as the connector below does."""
        is_serial = SERIAL.fullmatch(host) is not None
        line = (self._serial if is_serial else self._tcp).call(host, port, caller)
        # Only the newest to each place: a robot that is asked over HTTP has a line for each request.
        self._lines[host if is_serial else f"{host}:{port}"] = line
        return line

    def problems(self) -> list[str]:
        """Each line that is not open now, and why."""
        told = {where: str(getattr(line, "problem", "")) for where, line in self._lines.items()}
        return [f"{where}: {problem}" for where, problem in told.items() if problem]


@implementer(ILogObserver)
class Ear:
    """Hears what drivers warn of; each line once."""

    def __init__(self) -> None:
        self.heard: list[str] = []
        globalLogPublisher.addObserver(self)

    def __call__(self, event: LogEvent) -> None:
        """Take an event; called by the log."""
        level = event.get("log_level")
        if level is None or level < LogLevel.warn or not str(event.get("log_namespace", "")).startswith("drivers."):
            return
        line = " ".join(formatEvent(event).split())
        if line and line not in self.heard:
            self.heard.append(line)

    def close(self) -> None:
        """Hear no more."""
        globalLogPublisher.removeObserver(self)
