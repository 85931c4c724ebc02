"""Start, update and reap the process of a dead man's switch from the reactor's thread.

The process shares the robot's open link: the link's descriptor is passed to it over a Unix socket. The process starts
with the first link and ends with the driver; if it dies, it is restarted with growing delays.
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

from drivers.deadman.process import ARM, DISARM, HEADER, LINK_LOST, SET_LINK, SET_SERVER, now
from drivers.deadman.switch import DeadManSwitch, HaltCommand
from drivers.link import reactor_or_running

PROGRAM = Path(__file__).resolve().with_name("process.py")
FLUSH_S = 0.02
"""Seconds after which sent data has left this process, in one of the reactor's next iterations."""
MIN_RESTART_S, MAX_RESTART_S = 0.1, 5.0
"""Initial and maximum delay in seconds before a process that died is restarted."""
REAP_INTERVAL_S, KILL_TIMEOUT_S = 0.01, 1.0
"""Interval in seconds at which an ending process is checked, and seconds after which it is killed."""

log = Logger()


def create_switch(robot: str) -> DeadManSwitch | None:
    """Return a switch for ``robot``; on a system that cannot run one log a warning and return None."""
    if os.name != "posix" or not hasattr(socket, "send_fds") or not sys.executable or not PROGRAM.exists():
        log.warn(
            "{robot}: this system has no dead man's switch; if this node freezes, the robot keeps moving", robot=robot
        )
        return None
    return Supervisor(robot)


@implementer(IReadDescriptor)
class Supervisor:
    """The switch for ``robot`` on ``reactor`` (None: the running one)."""

    log = Logger()

    def __init__(self, robot: str, reactor: Any = None) -> None:
        self.halts = 0
        self._robot = robot
        self._given_reactor = reactor
        self._process: subprocess.Popen[bytes] | None = None
        self._ending_processes: list[subprocess.Popen[bytes]] = []
        self._reap_timer: Any = None
        self._socket: socket.socket | None = None
        self._started_at = 0.0
        self._restart_s = MIN_RESTART_S
        self._halt_command: HaltCommand | None = None
        self._motion_ends_at: float | None = None
        self._is_link_lost = False
        self._settle_timer: Any = None
        self._start_timer: Any = None
        self._has_warned = False
        self._closed: Deferred[None] | None = None

    @property
    def pid(self) -> int | None:
        """The id of the process, None if there is none."""
        return None if self._process is None else self._process.pid

    # -- the switch -------------------------------------------------------------------------------------------------

    def set_halt_command(self, command: HaltCommand) -> None:
        """Set the halt command; call this when a link opens or the command changes."""
        if self._closed is not None:
            return
        self._halt_command, self._is_link_lost = command, False
        if self._socket is not None:
            self._send_halt_command()
        elif self._start_timer is None:
            self._start()

    def arm(self, seconds: float) -> None:
        """Announce, before a motion is commanded, that it is in force for ``seconds`` from now."""
        if not self._is_link_lost:
            self._cancel("_settle_timer")
        # Both processes read the same clock, so a delayed message still carries the correct time.
        self._motion_ends_at = now() + seconds
        self._send(ARM, self._motion_ends_at)

    def disarm(self) -> None:
        """Announce that a halt was sent: once the halt has left this process, no motion is in force."""
        if self._motion_ends_at is not None and self._closed is None:
            self._schedule_settle()

    def on_link_lost(self) -> None:
        """Announce that the link is lost."""
        if self._halt_command is not None and self._closed is None:
            self._is_link_lost = True
            self._schedule_settle()

    def close(self) -> Deferred[None]:
        """End the process after pending data has left; fires when it has ended."""
        if self._closed is not None:
            return succeed(None)
        self._cancel("_start_timer")
        closed = self._closed = Deferred()
        if self._socket is not None:
            self._schedule_settle()
        else:
            self._cancel("_settle_timer")
            self._reap(KILL_TIMEOUT_S)
        return closed

    # -- to the process ---------------------------------------------------------------------------------------------

    def _schedule_settle(self) -> None:
        if self._settle_timer is None:
            self._settle_timer = self._reactor.callLater(FLUSH_S, self._settle)

    def _settle(self) -> None:
        self._settle_timer = None
        is_last = self._closed is not None
        if (
            not is_last
            and not self._is_link_lost
            and self._halt_command is not None
            and self._halt_command.link.is_busy
        ):
            # The halt is still buffered in this process and would freeze with it.
            self._schedule_settle()
            return
        self._motion_ends_at = None
        self._send(DISARM)
        if self._is_link_lost:
            self._is_link_lost, self._halt_command = False, None
            self._send(LINK_LOST)
        if is_last:
            self._close_socket()
            self._reap(KILL_TIMEOUT_S)

    def _send_halt_command(self) -> None:
        command = self._halt_command
        if command is None:
            return
        if command.address is not None:
            host, port = command.address
            self._send(SET_SERVER, 0.0, f"{host}\0{port}\0".encode("ascii") + command.data)
            return
        descriptor = getattr(command.link, "fileno", lambda: -1)()
        if descriptor >= 0:
            self._send(SET_LINK, 0.0, command.data, [descriptor])

    def _send(
        self, kind: bytes, moment: float = 0.0, content: bytes = b"", descriptors: list[int] | None = None
    ) -> None:
        if self._socket is None:
            return
        message = HEADER.pack(kind, moment, len(content)) + content
        try:
            sent = socket.send_fds(self._socket, [message], descriptors or [])
        except BlockingIOError:
            sent = 0
        except OSError:
            return  # the process died; the next read reports it
        if sent < len(message) and self._process is not None:
            # The process does not read its messages.  Kill it; the next read notices its end and starts a new process.
            self._process.kill()

    # -- process ----------------------------------------------------------------------------------------------------

    @property
    def _reactor(self) -> Any:
        return reactor_or_running(self._given_reactor)

    def _start(self) -> None:
        self._start_timer = None
        if self._halt_command is None:
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
        self._socket, self._started_at = ours, now()
        self._reactor.addReader(self)
        self._send_halt_command()
        if self._motion_ends_at is not None:
            self._send(ARM, self._motion_ends_at)

    def _on_no_start(self, error: OSError) -> None:
        if not self._has_warned:
            self.log.warn(
                "{robot}: the dead man's switch did not start, retrying: {error}", robot=self._robot, error=error
            )
        self._has_warned = True
        self._schedule_start()

    def _schedule_start(self) -> None:
        self._start_timer = self._reactor.callLater(self._restart_s, self._start)
        self._restart_s = min(2.0 * self._restart_s, MAX_RESTART_S)

    def fileno(self) -> int:
        """Return the socket to the process, for Twisted."""
        return -1 if self._socket is None else self._socket.fileno()

    def logPrefix(self) -> str:  # noqa: N802 (Twisted's)
        """Return the prefix in the reactor's log."""
        return "deadman"

    def doRead(self) -> None:  # noqa: N802 (Twisted's)
        """Read the process's report that it halted the robot, or notice that the process died."""
        assert self._socket is not None
        try:
            data = self._socket.recv(4096)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self.halts += len(data)
            self.log.info("{robot}: this node was frozen, so its dead man's switch halted it", robot=self._robot)
        else:
            self._on_death()

    def connectionLost(self, reason: Failure) -> None:
        """Handle the loss of the socket."""
        self._on_death()

    def _on_death(self) -> None:
        if self._socket is None:
            return
        self._close_socket()
        if self._closed is None:
            if now() - self._started_at > MAX_RESTART_S:
                self._restart_s, self._has_warned = MIN_RESTART_S, False
            if not self._has_warned:
                self.log.warn("{robot}: its dead man's switch died; restarting it", robot=self._robot)
            self._has_warned = True
            self._schedule_start()
        else:
            self._cancel("_settle_timer")
        self._reap(0.0)

    def _close_socket(self) -> None:
        """Close the socket, which makes the process end by itself."""
        if self._socket is not None and self._process is not None:
            self._reactor.removeReader(self)
            self._socket.close()
            self._ending_processes.append(self._process)
            self._socket = self._process = None

    def _reap(self, patience: float) -> None:
        """Reap processes that have ended, and kill those that have not ended after ``patience`` seconds."""
        self._cancel("_reap_timer")
        self._ending_processes = [process for process in self._ending_processes if process.poll() is None]
        if self._ending_processes:
            if patience <= 0.0:
                for process in self._ending_processes:
                    process.kill()
            self._reap_timer = self._reactor.callLater(REAP_INTERVAL_S, self._reap, patience - REAP_INTERVAL_S)
        elif self._closed is not None and not self._closed.called:
            self._closed.callback(None)

    def _cancel(self, name: str) -> None:
        timer = getattr(self, name)
        setattr(self, name, None)
        if timer is not None and timer.active():
            timer.cancel()
