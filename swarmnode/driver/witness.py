"""Witness: what keeps a robot from being reached, heard from its lines and from what its driver logs."""

from __future__ import annotations

import re
from typing import Any

from twisted.logger import ILogObserver, LogEvent, LogLevel, formatEvent, globalLogPublisher
from zope.interface import implementer

SERIAL = re.compile(r".*[/\\].*|COM\d+", re.DOTALL)
"""A serial device is a path, or a port of Windows; all else is an address in a network."""


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
