"""Tests of ``drivers.serial`` with fake serial devices."""

from __future__ import annotations

import errno
from typing import Any

from twisted.internet.protocol import Protocol
from twisted.internet.task import Clock
from twisted.internet.testing import StringTransport
from twisted.python.failure import Failure
from twisted.trial.unittest import SynchronousTestCase

from drivers.link import MAX_RETRY_S, Link
from drivers.serial import FLUSH_TIMEOUT_S, MAX_BACKLOG_BYTES, SerialConnector, SerialReconnector, describe_problem


class Device(StringTransport):
    """A fake of Twisted's serial port: written data stays in ``dataBuffer`` until ``flush``."""

    def __init__(self, link: Protocol) -> None:
        super().__init__()
        self.dataBuffer = b""
        self._tempDataLen = 0
        self.link = link
        self.is_leaving = False

    def write(self, data: bytes) -> None:
        self.dataBuffer += data

    def flush(self) -> None:
        super().write(self.dataBuffer)
        self.dataBuffer = b""
        if self.is_leaving:
            self.connectionLost(Failure(OSError("closed")))

    def loseConnection(self) -> None:  # noqa: N802 (Twisted's)
        self.is_leaving = True
        if not self.dataBuffer:
            self.connectionLost(Failure(OSError("closed")))

    def stopReading(self) -> None:  # noqa: N802 (Twisted's)
        """Do nothing."""

    def stopWriting(self) -> None:  # noqa: N802 (Twisted's)
        """Do nothing."""

    def connectionLost(self, reason: Failure) -> None:
        self.link.connectionLost(reason)


class SerialTests(SynchronousTestCase):
    """A serial line over a fake device."""

    def setUp(self) -> None:
        self.clock = Clock()
        self.error: Exception | None = None
        self.asked: list[tuple[str, int, float]] = []
        self.devices: list[Device] = []
        self.heard: list[bytes] = []
        self.links: list[Link] = []
        self.downs = 0

    def opened(self, link: Protocol, device: str, baud: int, reactor: Any) -> Any:
        """Open a fake device, or raise ``error``."""
        self.asked.append((device, baud, reactor.seconds()))
        if self.error is not None:
            raise self.error
        self.devices.append(Device(link))
        link.makeConnection(self.devices[-1])
        return self.devices[-1]

    def link_up(self, link: Link) -> None:
        self.links.append(link)

    def link_down(self) -> None:
        self.downs += 1

    def data_received(self, data: bytes) -> None:
        self.heard.append(data)

    def line(self) -> SerialReconnector:
        line = SerialConnector(self.clock, self.opened).connect("/dev/robot", 115200, self)
        assert isinstance(line, SerialReconnector)
        return line

    def test_carries_bytes_both_ways(self) -> None:
        """An open device carries bytes in both directions; the link is busy while too many bytes are buffered."""
        self.line()
        self.clock.advance(0.0)
        self.assertEqual(self.asked, [("/dev/robot", 115200, 0.0)])
        self.devices[0].link.dataReceived(b"hello")
        self.links[0].send(b"there")
        self.assertIs(self.links[0].is_busy, False)
        self.links[0].send(b"." * MAX_BACKLOG_BYTES)
        self.assertIs(self.links[0].is_busy, True)
        self.devices[0].flush()
        self.assertEqual((self.heard, self.devices[0].value()[:5]), ([b"hello"], b"there"))

    def test_tries_again_with_back_off_and_names_why(self) -> None:
        """A device that cannot be opened is retried with growing delays; each cause is logged in one line."""
        line = self.line()
        for number, words in (
            (errno.ENOENT, "does not exist"),
            (errno.EACCES, "no permission"),
            (errno.EAGAIN, "busy"),
            (errno.EBUSY, "busy"),
            (errno.EISDIR, "not a serial device"),
            (errno.ENOTTY, "not a serial device"),
        ):
            self.error = OSError(number, "as the system says")
            self.clock.pump([0.1] * 30)
            self.assertIn(words, line.problem)
            self.assertNotIn("\n", line.problem)
        times = [at for _, _, at in self.asked]
        self.assertLess(times[1] - times[0], 0.2)
        self.assertTrue(1.8 < times[-1] - times[-2] <= MAX_RETRY_S + 0.2)
        self.error = None
        self.clock.pump([0.1] * 30)
        self.assertEqual((line.problem, len(self.links)), ("", 1))

    def test_names_errors_without_a_number(self) -> None:
        """An unknown error is reported with its own text.

        If a system error caused the unknown error, the text of the system error is reported.
        """
        self.assertIn("strange baud", describe_problem(ValueError("strange\nbaud")))
        try:
            try:
                raise OSError(errno.EACCES, "no")
            except OSError:
                raise ValueError("could not open") from None
        except ValueError as error:
            self.assertIn("no permission", describe_problem(error))

    def test_opens_again_after_a_pulled_cable(self) -> None:
        """A lost device is reported and opened again; data sent while it is closed is lost."""
        self.line()
        self.clock.advance(0.0)
        self.devices[0].connectionLost(Failure(OSError("gone")))
        self.links[0].send(b"lost")
        self.links[0].close()
        self.assertEqual((self.downs, len(self.links)), (1, 1))
        self.clock.advance(0.2)
        self.assertEqual((self.downs, len(self.links)), (1, 2))

    def test_hangs_up_after_what_was_sent(self) -> None:
        """``disconnect`` sends the remaining bytes and closes; no delayed call is left, even after a second call."""
        line = self.line()
        self.clock.advance(0.0)
        self.links[0].send(b"stop")
        gone = line.disconnect()
        line.disconnect()
        self.assertNoResult(gone)
        self.devices[0].flush()
        self.successResultOf(gone)
        self.assertEqual((self.devices[0].value(), self.downs), (b"stop", 1))
        self.successResultOf(line.disconnect())
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def test_hangs_up_on_a_device_that_takes_nothing(self) -> None:
        """A device that does not accept the remaining bytes is closed after a second."""
        line = self.line()
        self.clock.advance(0.0)
        self.links[0].send(b"stop")
        gone = line.disconnect()
        line.disconnect()
        self.clock.advance(FLUSH_TIMEOUT_S)
        self.successResultOf(gone)
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def test_hangs_up_before_it_is_open(self) -> None:
        """A line can be closed while it waits for its device."""
        self.error = OSError(errno.ENOENT, "none")
        line = self.line()
        self.clock.advance(0.0)
        self.successResultOf(line.disconnect())
        self.assertEqual((self.clock.getDelayedCalls(), self.links), ([], []))
