"""Links over serial devices, for robots on a cable.

``SerialConnector`` has the interface of ``drivers.link.Connector``, so ``MemoryConnector`` can replace it; the
argument ``host`` is the device, and ``port`` is the baud rate.  pyserial (the extra ``serial``) is imported by the
first ``connect``.
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
    MAX_RETRY_S,
    RETRY_FACTOR,
    LinkClient,
    Reconnector,
    StreamLink,
    reactor_or_running,
)
from drivers.timer import Timer

FLUSH_TIMEOUT_S = 1.0
"""Maximum seconds for writing data that was sent before ``disconnect``."""
MAX_BACKLOG_BYTES = 4096
"""Number of unsent bytes above which a link is busy."""
PROBLEMS = {
    errno.ENOENT: "the device does not exist; plug the robot in, or correct the option port",
    errno.EACCES: "no permission; add this user to the device's group (often dialout), and log in again",
    errno.EPERM: "no permission; add this user to the device's group (often dialout), and log in again",
    errno.EBUSY: "the port is busy: another program has it open; end that program",
    errno.EAGAIN: "the port is busy: another program has it open; end that program",
    errno.EIO: "the device does not answer; plug it in again",
    errno.ENXIO: "the device was removed; plug it in again",
    errno.ENODEV: "the device was removed; plug it in again",
    errno.EISDIR: "this is not a serial device; correct the option port",
    errno.ENOTTY: "this is not a serial device; correct the option port",
}

Opener = Callable[[protocol.Protocol, str, int, Any], Any]
"""Opens a device at a baud rate on a reactor and attaches a protocol; raises ``OSError`` or ``ValueError``."""


def describe_problem(error: Exception) -> str:
    """Return the reason why a device cannot be opened, and the remedy, in one line."""
    number = getattr(error, "errno", None)
    # pyserial wraps errors of the system into its own exceptions, some of them without the errno.
    if number is None and error.__context__ is not None and error.__context__.args:
        number = error.__context__.args[0]
    return PROBLEMS.get(
        number if isinstance(number, int) else 0, f"it cannot be opened: {' '.join(str(error).split())}"
    )


class SerialConnector:
    """Opens links over serial devices on ``reactor`` (None: the running one)."""

    def __init__(self, reactor: Any = None, opener: Opener | None = None) -> None:
        self._reactor = reactor
        self._opener = opener

    def connect(self, host: str, port: int, client: LinkClient) -> Reconnector:
        """Keep ``client`` connected to the device ``host`` at ``port`` baud, with back-off, until ``disconnect``.

        Raises ``UsageError`` if pyserial is missing.
        """
        reactor = reactor_or_running(self._reactor)
        return SerialReconnector(host, port, client, reactor, _load_opener() if self._opener is None else self._opener)


class SerialReconnector:
    """Keeps a device open; ``problem`` is the reason in one line why the device is not open, and is logged once."""

    log = Logger()

    def __init__(self, device: str, baud: int, client: LinkClient, reactor: Any, opener: Opener) -> None:
        self.problem = ""
        self._device = device
        self._baud = baud
        self._client = client
        self._reactor = reactor
        self._opener = opener
        self._link: _SerialLink | None = None
        self._retry_s = FIRST_RETRY_S
        self._closed: Deferred[None] | None = None
        self._pending = Timer(reactor)
        self._pending.set(0.0, self._try_open)

    def disconnect(self) -> Deferred[None]:
        """Write pending data, close the device, and stop retrying; fires when the device is closed."""
        if self._link is None:
            self._pending.cancel()
            return succeed(None)
        if self._closed is None:
            self._closed = Deferred()
            self._pending.set(FLUSH_TIMEOUT_S, self._link.close)
            self._link.close_after_flush()
        return self._closed

    def on_link_lost(self) -> None:
        """Handle the close of the device; called by the link."""
        self._link = None
        closed, self._closed = self._closed, None
        self._pending.cancel()
        if closed is None:
            self._pending.set(FIRST_RETRY_S, self._try_open)
        self._client.link_down()
        if closed is not None:
            closed.callback(None)

    def _try_open(self) -> None:
        link = _SerialLink(self, self._client)
        try:
            self._opener(link, self._device, self._baud, self._reactor)
        except (OSError, ValueError) as error:
            self._log_problem(describe_problem(error))
            self._pending.set(self._retry_s, self._try_open)
            self._retry_s = min(self._retry_s * RETRY_FACTOR, MAX_RETRY_S)
            return
        self._retry_s = FIRST_RETRY_S
        self.problem = ""
        self._link = link
        self._client.link_up(link)

    def _log_problem(self, problem: str) -> None:
        if problem != self.problem:
            self.log.warn("{device}: {problem}", device=self._device, problem=problem)
        self.problem = problem


class _SerialLink(StreamLink):
    def __init__(self, reconnector: SerialReconnector, client: LinkClient) -> None:
        self._reconnector = reconnector
        self._client = client

    @property
    def is_busy(self) -> bool:
        transport: Any = self.transport
        return transport is not None and len(transport.dataBuffer) + transport._tempDataLen > MAX_BACKLOG_BYTES

    def close(self) -> None:
        transport: Any = self.transport
        if self.connected and transport is not None:
            # Twisted's serial port has no abort: report a lost connection instead.
            transport.stopReading()
            transport.stopWriting()
            transport.connectionLost(Failure(protocol.connectionDone.value))

    def close_after_flush(self) -> None:
        """Close after all pending data is written."""
        if self.transport is not None:
            self.transport.loseConnection()

    def dataReceived(self, data: bytes) -> None:
        self._client.data_received(data)

    def connectionLost(self, reason: Failure = protocol.connectionDone) -> None:
        if self.connected:
            self.connected = 0
            self._reconnector.on_link_lost()


def _load_opener() -> Opener:
    """Return the function that opens real devices for exclusive use."""
    try:
        from serial import Serial
        from twisted.internet.serialport import SerialPort
    except ImportError:
        raise UsageError(
            "serial devices need pyserial; install swarm-node with its extra: swarm-node[serial]"
        ) from None

    # Twisted does not lock ports; two programs on one port would each receive parts of the data.
    port: Any = type("Port", (SerialPort,), {"_serialFactory": partial(Serial, exclusive=True)})

    def open_device(link: protocol.Protocol, device: str, baud: int, reactor: Any) -> Any:
        return port(link, device, reactor, baudrate=baud)

    return open_device
