"""Keeper: a dead man's switch that is a process of its own, started, fed and reaped from the reactor's thread.

The process shares the robot's open link: the descriptor goes to it over a Unix socket.  It is started with the first
link and ends with the driver; one that dies is replaced, after ever longer waits.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReadDescriptor
from twisted.logger import Logger
from twisted.python.failure import Failure
from zope.interface import implementer

from drivers.deadman.process import CALL, GUARD, HEAD, LEAVE, REST, UNTIL, now
from drivers.deadman.switch import DeadMan, LastWord
from drivers.link import reactor_or_running

PROGRAM = Path(__file__).resolve().with_name("process.py")
LEAVE_S = 0.02
"""What is sent leaves with one of the reactor's next turns; until then it has not been said."""
FIRST_WAIT_S, LAST_WAIT_S = 0.1, 5.0
"""Before a process that died is replaced."""
REAP_S, END_S = 0.01, 1.0
"""How often a process is looked at that was told to end, and when it is ended."""

log = Logger()


def kept(robot: str) -> DeadMan | None:
    """A switch for ``robot``, or None, said once in the log, on a system where there can be none."""
    if os.name != "posix" or not hasattr(socket, "send_fds") or not sys.executable or not PROGRAM.exists():
        log.warn("{robot}: no dead man's switch on this system; when this node freezes, nobody halts it", robot=robot)
        return None
    return Keeper(robot)


@implementer(IReadDescriptor)
class Keeper:
    """Keeps the switch for ``robot`` on ``reactor`` (the running one where none is given)."""

    log = Logger()

    def __init__(self, robot: str, reactor: Any = None) -> None:
        self.halts = 0
        self._robot = robot
        self._given_reactor = reactor
        self._process: subprocess.Popen[bytes] | None = None
        self._ending: list[subprocess.Popen[bytes]] = []
        self._reaping: Any = None
        self._socket: socket.socket | None = None
        self._began = 0.0
        self._wait_s = FIRST_WAIT_S
        self._word: LastWord | None = None
        self._end: float | None = None
        self._is_leaving = False
        self._settling: Any = None
        self._starting: Any = None
        self._is_named = False
        self._closed: Deferred[None] | None = None

    @property
    def pid(self) -> int | None:
        """The process, None while there is none."""
        return None if self._process is None else self._process.pid

    # -- the switch -------------------------------------------------------------------------------------------------

    def guard(self, word: LastWord) -> None:
        """Halt the robot by this from now on: there is a link."""
        if self._closed is not None:
            return
        self._word, self._is_leaving = word, False
        if self._socket is not None:
            self._say_word()
        elif self._starting is None:
            self._start()

    def until(self, seconds: float) -> None:
        """Learn, before a motion is commanded, that it is in force for so long from now."""
        if not self._is_leaving:
            self._cancel("_settling")
        # Both processes have the same clock: a word that was late on its way says the right moment all the same.
        self._end = now() + seconds
        self._say(UNTIL, self._end)

    def rest(self) -> None:
        """Learn that a halt has just been sent, so that nothing is in force once it has left."""
        if self._end is not None and self._closed is None:
            self._settle_soon()

    def leave(self) -> None:
        """Learn that the link is gone."""
        if self._word is not None and self._closed is None:
            self._is_leaving = True
            self._settle_soon()

    def close(self) -> Deferred[None]:
        """End, once what was sent has left; fires when nothing is left of it."""
        if self._closed is not None:
            return succeed(None)
        self._cancel("_starting")
        closed = self._closed = Deferred()
        if self._socket is not None:
            self._settle_soon()
        else:
            self._cancel("_settling")
            self._reap(END_S)
        return closed

    # -- to the process ---------------------------------------------------------------------------------------------

    def _settle_soon(self) -> None:
        if self._settling is None:
            self._settling = self._reactor.callLater(LEAVE_S, self._settle)

    def _settle(self) -> None:
        self._settling = None
        is_last = self._closed is not None
        if not is_last and not self._is_leaving and self._word is not None and self._word.link.is_busy:
            # The halt waits in this process still, and would freeze with it.
            self._settle_soon()
            return
        self._end = None
        self._say(REST)
        if self._is_leaving:
            self._is_leaving, self._word = False, None
            self._say(LEAVE)
        if is_last:
            self._hang_up()
            self._reap(END_S)

    def _say_word(self) -> None:
        word = self._word
        if word is None:
            return
        if word.address is not None:
            host, port = word.address
            self._say(CALL, 0.0, f"{host}\0{port}\0".encode("ascii") + word.halt)
            return
        descriptor = getattr(word.link, "fileno", lambda: -1)()
        if descriptor >= 0:
            self._say(GUARD, 0.0, word.halt, [descriptor])

    def _say(
        self, kind: bytes, moment: float = 0.0, content: bytes = b"", descriptors: list[int] | None = None
    ) -> None:
        if self._socket is None:
            return
        said = HEAD.pack(kind, moment, len(content)) + content
        try:
            sent = socket.send_fds(self._socket, [said], descriptors or [])
        except BlockingIOError:
            sent = 0
        except OSError:
            return  # it died, as will be read
        if sent < len(said) and self._process is not None:
            # It does not listen: it is worth nothing.  Its end is read, and another one started.
            self._process.kill()

    # -- its life ---------------------------------------------------------------------------------------------------

    @property
    def _reactor(self) -> Any:
        return reactor_or_running(self._given_reactor)

    def _start(self) -> None:
        self._starting = None
        if self._word is None:
            return
        try:
            ours, theirs = socket.socketpair()
        except OSError as error:
            self._on_no_start(error)
            return
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", "-E", str(PROGRAM)],
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                cwd="/",
                start_new_session=True,
            )
        except OSError as error:
            ours.close()
            self._on_no_start(error)
            return
        finally:
            theirs.close()
        ours.setblocking(False)
        self._socket, self._began = ours, now()
        self._reactor.addReader(self)
        self._say_word()
        if self._end is not None:
            self._say(UNTIL, self._end)

    def _on_no_start(self, error: OSError) -> None:
        if not self._is_named:
            self.log.warn("{robot}: no dead man's switch yet: {error}", robot=self._robot, error=error)
        self._is_named = True
        self._start_later()

    def _start_later(self) -> None:
        self._starting = self._reactor.callLater(self._wait_s, self._start)
        self._wait_s = min(2.0 * self._wait_s, LAST_WAIT_S)

    def fileno(self) -> int:
        """The socket to the process; Twisted asks."""
        return -1 if self._socket is None else self._socket.fileno()

    def logPrefix(self) -> str:  # noqa: N802 (Twisted's)
        """Name it in the log of the reactor."""
        return "deadman"

    def doRead(self) -> None:  # noqa: N802 (Twisted's)
        """Hear that it halted the robot, or died."""
        assert self._socket is not None
        try:
            data = self._socket.recv(4096)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self.halts += len(data)
            self.log.info("{robot}: this node stood still, so its dead man's switch halted it", robot=self._robot)
        else:
            self._on_death()

    def connectionLost(self, reason: Failure) -> None:
        """The reactor has no use for the socket any more."""
        self._on_death()

    def _on_death(self) -> None:
        if self._socket is None:
            return
        self._hang_up()
        if self._closed is None:
            if now() - self._began > LAST_WAIT_S:
                self._wait_s, self._is_named = FIRST_WAIT_S, False
            if not self._is_named:
                self.log.warn("{robot}: its dead man's switch ended; another one is started", robot=self._robot)
            self._is_named = True
            self._start_later()
        else:
            self._cancel("_settling")
        self._reap(0.0)

    def _hang_up(self) -> None:
        """Close the socket: the process ends by itself."""
        if self._socket is not None and self._process is not None:
            self._reactor.removeReader(self)
            self._socket.close()
            self._ending.append(self._process)
            self._socket = self._process = None

    def _reap(self, patience: float) -> None:
        """Take note of processes that have ended, and end those that have not after so many seconds."""
        self._cancel("_reaping")
        self._ending = [one for one in self._ending if one.poll() is None]
        if self._ending:
            if patience <= 0.0:
                for process in self._ending:
                    process.kill()
            self._reaping = self._reactor.callLater(REAP_S, self._reap, patience - REAP_S)
        elif self._closed is not None and not self._closed.called:
            self._closed.callback(None)

    def _cancel(self, name: str) -> None:
        timer = getattr(self, name)
        setattr(self, name, None)
        if timer is not None and timer.active():
            timer.cancel()
