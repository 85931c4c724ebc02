"""Terminal: the keys of the terminal that this process runs in, one by one, and a line that is written anew."""

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
from middleware.entangled.control.word import printable


@implementer(IReadDescriptor)
class RealTerminal:
    """Standard input without echo and without waiting for whole lines, and standard output.

    Raises ``UsageError`` where there is no terminal.
    """

    def __init__(self, reactor: Any, keys: TextIO, out: TextIO) -> None:
        if not (keys.isatty() and out.isatty()):
            raise UsageError("there is no terminal here to press keys in; run it in one, not through a pipe")
        try:
            import termios
            import tty
        except ImportError:
            raise UsageError(
                "this system's terminal gives no single keys; it is supported on Linux and macOS"
            ) from None
        self._reactor = reactor
        self._out = out
        self._number = keys.fileno()
        before = termios.tcgetattr(self._number)
        tty.setcbreak(self._number)
        self._restore: Callable[[], None] = lambda: termios.tcsetattr(self._number, termios.TCSADRAIN, before)
        self._pressed: Callable[[str], None] | None = None
        self._is_closed = False

    def start(self, pressed: Callable[[str], None]) -> None:
        """Hand over each key at once; an empty one where there will be no more."""
        self._pressed = pressed
        self._reactor.addReader(self)

    def line(self, text: str) -> None:
        """Write the line anew, cut to the width of the terminal so that it stays one."""
        width = shutil.get_terminal_size().columns
        self._out.write(f"\r{printable(text)[: width - 1]}\x1b[K")
        self._out.flush()

    def say(self, text: str) -> None:
        """Write a line that stays."""
        self._out.write(f"\r{printable(text)}\x1b[K\n")
        self._out.flush()

    def close(self) -> None:
        """Leave the terminal as it was; may be called twice."""
        if self._is_closed:
            return
        self._is_closed = True
        self._reactor.removeReader(self)
        self._restore()
        self._out.write("\n")
        self._out.flush()

    def fileno(self) -> int:
        """Of standard input."""
        return self._number

    def doRead(self) -> None:  # noqa: N802 (Twisted's)
        """Take what was pressed; the bytes of an arrow or another long key are none of ours and do nothing."""
        try:
            data = os.read(self._number, 64)
        except OSError:
            data = b""
        if not data:
            self._reactor.removeReader(self)
        if self._pressed is not None:
            keys = [""] if not data else [] if data.startswith(b"\x1b") else list(data.decode("ascii", "ignore"))
            for key in keys:
                self._pressed(key)

    def connectionLost(self, reason: Failure) -> None:  # noqa: D102 (Twisted's)
        if self._pressed is not None:
            self._pressed("")

    def logPrefix(self) -> str:  # noqa: N802 (Twisted's)
        """What the log calls it."""
        return "terminal"


def real_terminal(reactor: Any) -> RealTerminal:
    """The terminal of this process; raises ``UsageError`` where there is none."""
    return RealTerminal(reactor, sys.stdin, sys.stdout)
