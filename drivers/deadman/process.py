"""Process: the dead man's switch itself, a program of its own that outlives a frozen node and halts the robot.

It hears from its node, over a socket that is its standard input, which bytes halt the robot, where they go, and until
which moment a motion is in force.  When that moment is over without a newer word, or the socket closes while a motion
is in force, it writes those bytes, three times.  It ends with the node.

It is started without site packages and imports next to nothing (``_socket`` and ``_signal`` spare it what ``socket``
and ``signal`` would load), so that it is ready within some 30 ms and takes some 9 MiB, of which not 4 are its own.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found, unused-ignore]
import _socket
import os
import select
import time
from struct import Struct

HEAD = Struct("<cdI")
"""Each word of the node: its kind, a moment, and how many bytes follow."""
GUARD, CALL, UNTIL, REST, LEAVE = b"g", b"c", b"u", b"r", b"l"
"""``GUARD`` brings a descriptor and the bytes that halt; ``CALL`` host, port and a request, with NUL between."""
HALTED = b"."
"""What the node is told each time."""
GRACE_S = 0.05
"""The node has so long after the end of a motion to say that it is at rest, before it is taken for frozen."""
AGAIN_S, TIMES = 0.1, 3
"""How often a halt is said: one that fell into a command that the node had written in part is lost."""
ANSWER_S = 0.25
"""A server has so long to answer a request."""
TICK_S = 0.05
"""Waiting stands still while the machine is suspended, so nothing in force is waited for longer than that."""
FDS = Struct("<i")


def now() -> float:
    """Seconds on the clock of this machine that no one sets and that counts time suspended; the node has the same."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class Open:
    """A way to the robot that is open: a socket or a serial device, whose other user is the node."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._left = b""

    def say(self, halt: bytes) -> bool:
        """Write without waiting, what was cut off last time first; nobody tells whether it was heard."""
        said = self._left + halt
        try:
            poll = select.poll()
            poll.register(self._descriptor, select.POLLOUT)
            if poll.poll(0):
                self._left = said[os.write(self._descriptor, said) :]
        except OSError:
            pass  # the link is dead: nobody can
        return False

    def close(self) -> None:
        """Let go of it: only then is it closed, if the node has closed it, too."""
        os.close(self._descriptor)


class Server:
    """A way to a robot that takes each command by a connection of its own."""

    def __init__(self, host: str, port: int) -> None:
        self._family = _socket.AF_INET6 if ":" in host else _socket.AF_INET
        self._address = (host, port)

    def say(self, request: bytes) -> bool:
        """Ask, and wait a little; whether it was answered."""
        asking = _socket.socket(self._family, _socket.SOCK_STREAM)
        try:
            asking.settimeout(ANSWER_S)
            asking.connect(self._address)
            asking.send(request)
            return bool(asking.recv(1))
        except OSError:
            return False
        finally:
            asking.close()

    def close(self) -> None:
        """Nothing is open."""


class Watch:
    """One robot: the way to it, what halts it, and until when a motion is in force."""

    def __init__(self) -> None:
        self.halts = 0
        self._way: Open | Server | None = None
        self._halt = b""
        self._end: float | None = None
        self._times = 0
        self._again_at = 0.0

    def guard(self, way: Open | Server, halt: bytes) -> None:
        """Halt by this from now on; what is in force stays so."""
        self._close()
        self._way, self._halt = way, halt

    def until(self, moment: float) -> None:
        """Take a motion that is in force up to ``moment``."""
        self._end, self._times = moment, 0

    def rest(self) -> None:
        """Take it that nothing is in force."""
        self._end, self._times = None, 0

    def leave(self) -> None:
        """Forget the way."""
        self.rest()
        self._close()

    def end(self, moment: float) -> None:
        """The node is gone: halt now, if anything is in force."""
        if self._end is not None:
            self._end = moment - GRACE_S

    def wait(self, moment: float) -> float | None:
        """Seconds until there is something to do; None where nothing is in force."""
        if self._times:
            return max(0.0, self._again_at - moment)
        return None if self._end is None else max(0.0, self._end + GRACE_S - moment)

    def turn(self, moment: float) -> None:
        """Do what is due."""
        if self._end is not None and moment >= self._end + GRACE_S:
            self._end = None
            if self._way is not None:
                self.halts += 1
                self._times, self._again_at = TIMES, moment
        if self._times and moment >= self._again_at and self._way is not None:
            self._times -= 1
            self._again_at = moment + AGAIN_S
            if self._way.say(self._halt):
                self._times = 0

    def _close(self) -> None:
        way, self._way = self._way, None
        self._times = 0
        if way is not None:
            way.close()


class Ear:
    """What the node says, cut anyhow, to the ``watch``."""

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        self._rest = b""
        self._descriptors: list[int] = []

    def heard(self, data: bytes, descriptors: list[int]) -> None:
        """Take bytes, and the descriptors that came with them."""
        self._descriptors += descriptors
        self._rest += data
        while len(self._rest) >= HEAD.size:
            kind, moment, size = HEAD.unpack_from(self._rest)
            if len(self._rest) < HEAD.size + size:
                return
            content = self._rest[HEAD.size : HEAD.size + size]
            self._rest = self._rest[HEAD.size + size :]
            if kind == GUARD:
                self._watch.guard(Open(self._descriptors.pop(0)), content)
            elif kind == CALL:
                host, port, request = content.split(b"\0", 2)
                self._watch.guard(Server(host.decode("ascii"), int(port)), request)
            elif kind == UNTIL:
                self._watch.until(moment)
            elif kind == REST:
                self._watch.rest()
            elif kind == LEAVE:
                self._watch.leave()


def main() -> None:
    """Watch until the node is gone, and the robot at rest."""
    # The node ends first, whoever is told to end: Ctrl-C and service managers tell all.
    for number in (_signal.SIGINT, _signal.SIGTERM, _signal.SIGHUP, _signal.SIGQUIT, _signal.SIGTSTP):
        _signal.signal(number, _signal.SIG_IGN)
    node = _socket.socket(fileno=0)
    node.setblocking(False)
    poll = select.poll()
    poll.register(0, select.POLLIN)
    watch = Watch()
    ear = Ear(watch)
    is_open = True
    while True:
        told = watch.halts
        wait = watch.wait(now())
        if not is_open:
            if wait is None:
                return
            time.sleep(wait)
        elif poll.poll(None if wait is None else 1000.0 * min(wait, TICK_S) + 1.0):
            is_open = listened(node, ear)
            if not is_open:
                watch.end(now())
        watch.turn(now())
        if watch.halts > told and is_open:
            tell(node)


def tell(node: _socket.socket) -> None:
    """Say that the robot was halted; a frozen node reads it later."""
    try:
        node.send(HALTED)
    except OSError:
        return  # it is gone, as will be heard


def listened(node: _socket.socket, ear: Ear) -> bool:
    """Hear all that there is to hear, so that newer words count before time does; whether the node is there."""
    while True:
        try:
            data, extras, _, _ = node.recvmsg(65536, _socket.CMSG_SPACE(4 * FDS.size))
        except BlockingIOError:
            return True
        except OSError:
            return False
        descriptors = [
            fd
            for level, kind, some in extras
            if (level, kind) == (_socket.SOL_SOCKET, _socket.SCM_RIGHTS)
            for (fd,) in FDS.iter_unpack(some[: len(some) // FDS.size * FDS.size])
        ]
        if not data:
            return False
        ear.heard(data, descriptors)


if __name__ == "__main__":
    main()
