"""Single keys from the terminal of this process, and a status line."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable
from typing import Any, TextIO

from twisted.internet.interfaces import IReadDescriptor
from twisted.python.failure import Failure
from zope.interface import implementer

from drivers.errors import UsageError
from middleware.entangled.control.conversion import remove_control_characters


@implementer(IReadDescriptor)
class RealTerminal:
    """Standard input in cbreak mode without echo, and standard output.

    Raises ``UsageError`` if there is no terminal.
    """

    def __init__(self, reactor: Any, keys: TextIO, out: TextIO) -> None:
        if not (keys.isatty() and out.isatty()):
            raise UsageError("standard input is not a terminal; run this command in a terminal, without a pipe")
        try:
            import termios
            import tty
        except ImportError:
            raise UsageError("this system's terminal does not support single keys; use Linux or macOS") from None
        self._reactor = reactor
        self._out = out
        self._fd = keys.fileno()
        before = termios.tcgetattr(self._fd)
        tty.setcbreak(self._fd)
        self._restore: Callable[[], None] = lambda: termios.tcsetattr(self._fd, termios.TCSADRAIN, before)
        self._on_key: Callable[[str], None] | None = None
        self._is_closed = False

    def start(self, pressed: Callable[[str], None]) -> None:
        """Call ``pressed`` with each key immediately; with an empty string at the end of input."""
        self._on_key = pressed
        self._reactor.addReader(self)

    def show_status(self, text: str) -> None:
        """Overwrite the status line, cut to the width of the terminal."""
        width = shutil.get_terminal_size().columns
        self._out.write(f"\r{remove_control_characters(text)[: width - 1]}\x1b[K")
        self._out.flush()

    def write_line(self, text: str) -> None:
        """Write a permanent line."""
        self._out.write(f"\r{remove_control_characters(text)}\x1b[K\n")
        self._out.flush()

    def close(self) -> None:
        """Restore the terminal; may be called twice."""
        if self._is_closed:
            return
        self._is_closed = True
        self._reactor.removeReader(self)
        self._restore()
        self._out.write("\n")
        self._out.flush()

    def fileno(self) -> int:
        """Return the file descriptor of standard input."""
        return self._fd

    def doRead(self) -> None:  # noqa: N802 (Twisted's)
        """Read keys; escape sequences, such as arrow keys, are ignored."""
        try:
            data = os.read(self._fd, 64)
        except OSError:
            data = b""
        if not data:
            self._reactor.removeReader(self)
        if self._on_key is not None:
            keys = [""] if not data else [] if data.startswith(b"\x1b") else list(data.decode("ascii", "ignore"))
            for key in keys:
                self._on_key(key)

    def connectionLost(self, reason: Failure) -> None:  # noqa: D102 (Twisted's)
        if self._on_key is not None:
            self._on_key("")

    def logPrefix(self) -> str:  # noqa: N802 (Twisted's)
        """Return the name in the log."""
        return "terminal"


def open_terminal(reactor: Any) -> RealTerminal:
    """Return the terminal of this process; raises ``UsageError`` if there is none."""
    return RealTerminal(reactor, sys.stdin, sys.stdout)
