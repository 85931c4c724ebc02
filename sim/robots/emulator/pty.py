"""Pty: an emulator's serial port as a pseudo-terminal, which any program opens like a robot's own."""

from __future__ import annotations

import os
import pty
import tty
from typing import Any

from twisted.internet import abstract, fdesc
from twisted.python.failure import Failure

from drivers.link import Accept, Receiver

BACKLOG = 512
"""Bytes that wait to be taken; about as many as a real adapter keeps."""
TERMINALS = "/dev/pts/"
"""Where a link leads that was left behind by a port which could not remove it."""


class PtyPort(abstract.FileDescriptor):
    """A port at ``path``; what ``accept`` returns hears what is written to the path, until ``unplug``.

    ``link`` names the path: a symbolic link that is made, and removed again.  One that was left behind is replaced;
    anything else there, as a real device, stays: then ``FileExistsError`` is raised.
    """

    def __init__(self, reactor: Any, accept: Accept, link: str = "") -> None:
        super().__init__(reactor)
        self._master, slave = pty.openpty()
        tty.setraw(self._master)
        self.path = os.ttyname(slave)
        # Held open, so that a program which closes the port can open it again, as with a real cable.
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
        """Whether nobody takes what the robot says."""
        return len(self.dataBuffer) + self._tempDataLen > BACKLOG

    def send(self, data: bytes) -> None:
        """Say something; lost where nobody takes what was said before, as on a cable."""
        if self.connected and not self.is_busy:
            self.write(data)

    def close(self) -> None:
        """Pull the cable: who has the port open loses it."""
        if self.connected:
            self.stopReading()
            self.stopWriting()
            self.connectionLost(Failure(OSError("unplugged")))

    def fileno(self) -> int:  # noqa: D102 (Twisted's)
        return self._master if self.connected else -1

    def doRead(self) -> Any:  # noqa: D102, N802 (Twisted's)
        return fdesc.readFromFD(self._master, self._heard)

    def writeSomeData(self, data: bytes) -> Any:  # noqa: D102, N802 (Twisted's)
        return fdesc.writeToFD(self._master, data)

    def connectionLost(self, reason: Failure) -> None:  # noqa: D102 (Twisted's)
        super().connectionLost(reason)
        self.connected = 0
        os.close(self._master)
        os.close(self._slave)
        if self._link and _target(self._link) == self._device:
            os.unlink(self._link)
        receiver, self._receiver = self._receiver, None
        if receiver is not None:
            receiver.link_down()

    def _make_link(self) -> None:
        if _target(self._link).startswith(TERMINALS):
            os.unlink(self._link)
        os.symlink(self._device, self._link)

    def _heard(self, data: bytes) -> None:
        if self._receiver is not None:
            self._receiver.received(data)


def _target(link: str) -> str:
    """Where a symbolic link leads; empty where there is none."""
    try:
        return os.readlink(link)
    except OSError:
        return ""
