"""Serial: links over serial devices, for drivers whose robot hangs on a cable.

``SerialConnector`` is the edge to the world; it keeps the seam of ``drivers.link``, so that ``MemoryConnector`` is its
twin: the host is the device, the port the baud rate.  pyserial (the extra ``serial``) is loaded when a line is called.
"""

from __future__ import annotations

import errno
from collections.abc import Callable
from functools import partial
from typing import Any

from twisted.internet import protocol
from twisted.internet.defer import Deferred, succeed
from twisted.logger import Logger
from twisted.python.failure import Failure

from drivers.errors import UsageError
from drivers.link import (
    FIRST_RETRY_S,
    LAST_RETRY_S,
    RETRY_FACTOR,
    Caller,
    Line,
    StreamLink,
    reactor_or_running,
)
from drivers.timer import Timer

FLUSH_S = 1.0
"""What was sent before hanging up has so long to leave."""
BACKLOG = 4096
"""Above so many bytes that have not left, a link is busy."""
PROBLEMS = {
    errno.ENOENT: "there is no such device; plug the robot in, or correct the option port",
    errno.EACCES: "no permission; add this user to the device's group (often dialout), and sign in anew",
    errno.EPERM: "no permission; add this user to the device's group (often dialout), and sign in anew",
    errno.EBUSY: "the port is busy: another program has it open; end that",
    errno.EAGAIN: "the port is busy: another program has it open; end that",
    errno.EIO: "the device does not answer; plug it in again",
    errno.ENXIO: "the device is gone; plug it in again",
    errno.ENODEV: "the device is gone; plug it in again",
    errno.EISDIR: "this is no serial device; correct the option port",
    errno.ENOTTY: "this is no serial device; correct the option port",
}

Opener = Callable[[protocol.Protocol, str, int, Any], Any]
"""Opens a device at a baud rate on a reactor and joins a protocol to it; raises ``OSError`` or ``ValueError``."""


def problem_of(error: Exception) -> str:
    """What keeps a device from being opened, and the remedy, in one line."""
    number = getattr(error, "errno", None)
    # pyserial wraps what the system and the terminal say into errors of its own, some without their number.
    if number is None and error.__context__ is not None and error.__context__.args:
        number = error.__context__.args[0]
    return PROBLEMS.get(
        number if isinstance(number, int) else 0, f"it cannot be opened: {' '.join(str(error).split())}"
    )


class SerialConnector:
    """Opens links over serial devices on ``reactor`` (the running one where none is given)."""

    def __init__(self, reactor: Any = None, opener: Opener | None = None) -> None:
        self._reactor = reactor
        self._opener = opener

    def call(self, host: str, port: int, caller: Caller) -> Line:
        """Keep ``caller`` connected to the device ``host`` at ``port`` baud, with back-off, until the line hangs up.

        Raises ``UsageError`` where pyserial is missing.
        """
        reactor = reactor_or_running(self._reactor)
        return SerialLine(host, port, caller, reactor, _opener() if self._opener is None else self._opener)


class SerialLine:
    """A standing wish to have a device open; ``problem`` says in one line why it is not, and is logged once."""

    log = Logger()

    def __init__(self, device: str, baud: int, caller: Caller, reactor: Any, opener: Opener) -> None:
        self.problem = ""
        self._device = device
        self._baud = baud
        self._caller = caller
        self._reactor = reactor
        self._opener = opener
        self._link: _SerialLink | None = None
        self._retry_s = FIRST_RETRY_S
        self._gone: Deferred[None] | None = None
        self._pending = Timer(reactor)
        self._pending.set(0.0, self._try)

    def hang_up(self) -> Deferred[None]:
        """Let what was sent leave, close the device, stop trying; fires when it is closed."""
        if self._link is None:
            self._pending.cancel()
            return succeed(None)
        if self._gone is None:
            self._gone = Deferred()
            self._pending.set(FLUSH_S, self._link.close)
            self._link.leave()
        return self._gone

    def link_lost(self) -> None:
        """Learn from the link that the device is closed."""
        self._link = None
        gone, self._gone = self._gone, None
        self._pending.cancel()
        if gone is None:
            self._pending.set(FIRST_RETRY_S, self._try)
        self._caller.link_down()
        if gone is not None:
            gone.callback(None)

    def _try(self) -> None:
        link = _SerialLink(self, self._caller)
        try:
            self._opener(link, self._device, self._baud, self._reactor)
        except (OSError, ValueError) as error:
            self._name(problem_of(error))
            self._pending.set(self._retry_s, self._try)
            self._retry_s = min(self._retry_s * RETRY_FACTOR, LAST_RETRY_S)
            return
        self._retry_s = FIRST_RETRY_S
        self.problem = ""
        self._link = link
        self._caller.link_up(link)

    def _name(self, problem: str) -> None:
        if problem != self.problem:
            self.log.warn("{device}: {problem}", device=self._device, problem=problem)
        self.problem = problem


class _SerialLink(StreamLink):
    """A link over one open device."""

    def __init__(self, line: SerialLine, caller: Caller) -> None:
        self._line = line
        self._caller = caller

    @property
    def is_busy(self) -> bool:
        transport: Any = self.transport
        return transport is not None and len(transport.dataBuffer) + transport._tempDataLen > BACKLOG

    def close(self) -> None:
        transport: Any = self.transport
        if self.connected and transport is not None:
            # A serial port has no abort: it is closed as if it had been lost.
            transport.stopReading()
            transport.stopWriting()
            transport.connectionLost(Failure(protocol.connectionDone.value))

    def leave(self) -> None:
        """Close as soon as everything has left."""
        if self.transport is not None:
            self.transport.loseConnection()

    def dataReceived(self, data: bytes) -> None:
        self._caller.received(data)

    def connectionLost(self, reason: Failure = protocol.connectionDone) -> None:
        if self.connected:
            self.connected = 0
            self._line.link_lost()


def _opener() -> Opener:
    """What opens real devices, each for one program alone."""
    try:
        from serial import Serial
        from twisted.internet.serialport import SerialPort
    except ImportError:
        raise UsageError(
            "serial devices need pyserial; install swarm-node with its extra: swarm-node[serial]"
        ) from None

    # Twisted opens ports that others have open as well; of two programs, neither would understand the robot.
    port: Any = type("Port", (SerialPort,), {"_serialFactory": partial(Serial, exclusive=True)})

    def opened(link: protocol.Protocol, device: str, baud: int, reactor: Any) -> Any:
        return port(link, device, reactor, baudrate=baud)

    return opened
