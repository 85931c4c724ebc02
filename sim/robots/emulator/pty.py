"""An emulator's serial port as a pseudo-terminal, which programs open like a real port."""

from __future__ import annotations

import os
import pty
import tty
from typing import Any

from twisted.internet import abstract, fdesc
from twisted.python.failure import Failure

from drivers.link import Accept, Receiver

MAX_BACKLOG_BYTES = 512
"""Number of unread bytes above which the port is busy; about the buffer of a real adapter."""
PTY_FOLDER = "/dev/pts/"
"""Folder of the targets of symbolic links; such a link may be left behind by a port that could not remove it."""


class PtyPort(abstract.FileDescriptor):
    """A port at ``path``; the receiver that ``accept`` returns gets the data written to the port, until ``close``.

    ``link`` is the path of a symbolic link to the port, which is created and later removed. A link left behind by
    another port is replaced; any other file at this path, such as a real device, raises ``FileExistsError``.
    """

    def __init__(self, reactor: Any, accept: Accept, link: str = "") -> None:
        super().__init__(reactor)
        self._master, slave = pty.openpty()
        tty.setraw(self._master)
        self.path = os.ttyname(slave)
        # Keep the slave open, so that a program can close and reopen the port, as with a real cable.
        self._slave = slave
        self._device = self.path
        self._link = link
        if link:
            try:
                self._make_link()
            except OSError:
                os.close(self._master)
                os.close(slave)
                raise
            self.path = link
        fdesc.setNonBlocking(self._master)
        self._receiver: Receiver | None = None
        self.connected = 1
        self._receiver = accept(self)
        self.startReading()

    @property
    def is_busy(self) -> bool:
        """Whether too much output is unread."""
        return len(self.dataBuffer) + self._tempDataLen > MAX_BACKLOG_BYTES

    def send(self, data: bytes) -> None:
        """Send data; while the port is busy, data is lost, as on a cable."""
        if self.connected and not self.is_busy:
            self.write(data)

    def close(self) -> None:
        """Unplug the cable: programs lose the open port."""
        if self.connected:
            self.stopReading()
            self.stopWriting()
            self.connectionLost(Failure(OSError("unplugged")))

    def fileno(self) -> int:  # noqa: D102 (Twisted's)
        return self._master if self.connected else -1

    def doRead(self) -> Any:  # noqa: D102, N802 (Twisted's)
        return fdesc.readFromFD(self._master, self._on_data)

    def writeSomeData(self, data: bytes) -> Any:  # noqa: D102, N802 (Twisted's)
        return fdesc.writeToFD(self._master, data)

    def connectionLost(self, reason: Failure) -> None:  # noqa: D102 (Twisted's)
        super().connectionLost(reason)
        self.connected = 0
        os.close(self._master)
        os.close(self._slave)
        if self._link and _read_link(self._link) == self._device:
            os.unlink(self._link)
        receiver, self._receiver = self._receiver, None
        if receiver is not None:
            receiver.link_down()

    def _make_link(self) -> None:
        if _read_link(self._link).startswith(PTY_FOLDER):
            os.unlink(self._link)
        os.symlink(self._device, self._link)

    def _on_data(self, data: bytes) -> None:
        if self._receiver is not None:
            self._receiver.data_received(data)


def _read_link(link: str) -> str:
    """Return the target of a symbolic link; empty if there is none."""
    try:
        return os.readlink(link)
    except OSError:
        return ""
