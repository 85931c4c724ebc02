"""The process of the dead man's switch, which halts the robot if the node freezes or ends.

The node sends messages to the socket that is the standard input of this process: the bytes that halt the robot, their
destination, and the end of the motion in force. When that time passes and no newer message has arrived, or when the
socket closes while a motion is in force, this process sends these bytes to the robot, three times. It ends with the
node.

The process starts without site packages and imports almost nothing, so it is ready within about 30 ms and takes about
9 MiB of memory, of which less than 4 are private. ``_socket`` and ``_signal`` avoid the imports of ``socket`` and
``signal``.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found, unused-ignore]
import _socket
import os
import select
import time
from struct import Struct

HEADER = Struct("<cdI")
"""Header of each message from the node: kind, time, and number of bytes that follow."""
SET_LINK, SET_SERVER, ARM, DISARM, LINK_LOST = b"g", b"c", b"u", b"r", b"l"
"""Kinds of messages.

``SET_LINK`` contains a descriptor and the bytes that halt; ``SET_SERVER`` contains host, port and a request, separated
by NUL.
"""
HALTED = b"."
"""Sent to the node after each halt."""
GRACE_S = 0.05
"""Seconds after the end of a motion within which the node must report rest; otherwise it is regarded as frozen."""
HALT_REPEAT_S, HALT_COUNT = 0.1, 3
"""Interval and number of halts: a halt that is written into the middle of an incomplete command is lost."""
ANSWER_S = 0.25
"""Seconds to wait for a server's answer."""
TICK_S = 0.05
"""Maximum wait in seconds while a motion is in force: the timer of a wait stops while the machine is suspended."""
FD_STRUCT = Struct("<i")


def now() -> float:
    """Return seconds on a clock that is never set and counts suspended time; the node uses the same clock."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class SharedLink:
    """An open connection to the robot, a socket or a serial device, which the node uses as well."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._unsent = b""

    def send(self, halt: bytes) -> bool:
        """Write without blocking, first the bytes left from the last call; return False: no answer confirms it."""
        data = self._unsent + halt
        try:
            poll = select.poll()
            poll.register(self._descriptor, select.POLLOUT)
            if poll.poll(0):
                self._unsent = data[os.write(self._descriptor, data) :]
        except OSError:
            pass  # the link is broken
        return False

    def close(self) -> None:
        """Close this descriptor; the connection closes when the node has closed its descriptor as well."""
        os.close(self._descriptor)


class CommandServer:
    """A robot that takes each command over a new connection."""

    def __init__(self, host: str, port: int) -> None:
        self._family = _socket.AF_INET6 if ":" in host else _socket.AF_INET
        self._address = (host, port)

    def send(self, request: bytes) -> bool:
        """Send the request and wait up to ``ANSWER_S``; return whether it was answered."""
        connection = _socket.socket(self._family, _socket.SOCK_STREAM)
        try:
            connection.settimeout(ANSWER_S)
            connection.connect(self._address)
            connection.send(request)
            return bool(connection.recv(1))
        except OSError:
            return False
        finally:
            connection.close()

    def close(self) -> None:
        """Do nothing: no connection is open."""


class HaltTimer:
    """One robot: its connection, its halt command, and the end of the motion in force."""

    def __init__(self) -> None:
        self.halts = 0
        self._target: SharedLink | CommandServer | None = None
        self._halt = b""
        self._motion_ends_at: float | None = None
        self._halts_left = 0
        self._next_halt_at = 0.0

    def set_halt_command(self, target: SharedLink | CommandServer, halt: bytes) -> None:
        """Set the connection and the halt command; does not affect a motion in force."""
        self._close()
        self._target, self._halt = target, halt

    def arm(self, moment: float) -> None:
        """Set the end of the motion in force."""
        self._motion_ends_at, self._halts_left = moment, 0

    def disarm(self) -> None:
        """Clear the motion in force."""
        self._motion_ends_at, self._halts_left = None, 0

    def on_link_lost(self) -> None:
        """Clear the motion and close the connection."""
        self.disarm()
        self._close()

    def on_node_end(self, moment: float) -> None:
        """Handle the end of the node: halt now if a motion is in force."""
        if self._motion_ends_at is not None:
            self._motion_ends_at = moment - GRACE_S

    def get_timeout(self, moment: float) -> float | None:
        """Return the seconds until ``send_due_halts`` is due; None if no motion is in force."""
        if self._halts_left:
            return max(0.0, self._next_halt_at - moment)
        return None if self._motion_ends_at is None else max(0.0, self._motion_ends_at + GRACE_S - moment)

    def send_due_halts(self, moment: float) -> None:
        """Send the halts that are due."""
        if self._motion_ends_at is not None and moment >= self._motion_ends_at + GRACE_S:
            self._motion_ends_at = None
            if self._target is not None:
                self.halts += 1
                self._halts_left, self._next_halt_at = HALT_COUNT, moment
        if self._halts_left and moment >= self._next_halt_at and self._target is not None:
            self._halts_left -= 1
            self._next_halt_at = moment + HALT_REPEAT_S
            if self._target.send(self._halt):
                self._halts_left = 0

    def _close(self) -> None:
        target, self._target = self._target, None
        self._halts_left = 0
        if target is not None:
            target.close()


class MessageParser:
    """Parses messages of the node, however they are split into chunks, and applies them to ``halt_timer``."""

    def __init__(self, halt_timer: HaltTimer) -> None:
        self._halt_timer = halt_timer
        self._rest = b""
        self._descriptors: list[int] = []

    def feed(self, data: bytes, descriptors: list[int]) -> None:
        """Process received bytes, and the descriptors that arrived with them."""
        self._descriptors += descriptors
        self._rest += data
        while len(self._rest) >= HEADER.size:
            kind, moment, size = HEADER.unpack_from(self._rest)
            if len(self._rest) < HEADER.size + size:
                return
            content = self._rest[HEADER.size : HEADER.size + size]
            self._rest = self._rest[HEADER.size + size :]
            if kind == SET_LINK:
                self._halt_timer.set_halt_command(SharedLink(self._descriptors.pop(0)), content)
            elif kind == SET_SERVER:
                host, port, request = content.split(b"\0", 2)
                self._halt_timer.set_halt_command(CommandServer(host.decode("ascii"), int(port)), request)
            elif kind == ARM:
                self._halt_timer.arm(moment)
            elif kind == DISARM:
                self._halt_timer.disarm()
            elif kind == LINK_LOST:
                self._halt_timer.on_link_lost()


def main() -> None:
    """Run until the node has ended and the robot is at rest."""
    # Ctrl-C and service managers send signals to all processes; this process ignores them, to end after its node.
    for number in (_signal.SIGINT, _signal.SIGTERM, _signal.SIGHUP, _signal.SIGQUIT, _signal.SIGTSTP):
        _signal.signal(number, _signal.SIG_IGN)
    node = _socket.socket(fileno=0)
    node.setblocking(False)
    poll = select.poll()
    poll.register(0, select.POLLIN)
    halt_timer = HaltTimer()
    parser = MessageParser(halt_timer)
    is_open = True
    while True:
        halts_before = halt_timer.halts
        wait = halt_timer.get_timeout(now())
        if not is_open:
            if wait is None:
                return
            time.sleep(wait)
        elif poll.poll(None if wait is None else 1000.0 * min(wait, TICK_S) + 1.0):
            is_open = read_messages(node, parser)
            if not is_open:
                halt_timer.on_node_end(now())
        halt_timer.send_due_halts(now())
        if halt_timer.halts > halts_before and is_open:
            report_halt(node)


def report_halt(node: _socket.socket) -> None:
    """Report a halt to the node; a frozen node reads it later."""
    try:
        node.send(HALTED)
    except OSError:
        return  # the node has ended; the next read reports it


def read_messages(node: _socket.socket, parser: MessageParser) -> bool:
    """Read all pending messages before the time is checked; return whether the node still runs."""
    while True:
        try:
            data, extras, _, _ = node.recvmsg(65536, _socket.CMSG_SPACE(4 * FD_STRUCT.size))
        except BlockingIOError:
            return True
        except OSError:
            return False
        descriptors = [
            fd
            for level, kind, some in extras
            if (level, kind) == (_socket.SOL_SOCKET, _socket.SCM_RIGHTS)
            for (fd,) in FD_STRUCT.iter_unpack(some[: len(some) // FD_STRUCT.size * FD_STRUCT.size])
        ]
        if not data:
            return False
        parser.feed(data, descriptors)


if __name__ == "__main__":
    main()
