"""Port: finds out which ports of this machine are free."""

from __future__ import annotations

import errno
import random
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Literal

Kind = Literal["tcp", "udp"]
BOTH: tuple[Kind, ...] = ("tcp", "udp")

QUIET = range(20_000, 32_000)
"""Systems hand out none of these by themselves (Linux begins at 32,768, others at 49,152): a port that is free here
is still free when the process starts that it was looked up for, however many connections others open meanwhile."""


class PortBusy(Exception):
    """A port that was asked for is held by another program; the message names it and says what to do."""


def chosen(kind: Kind, host: str, wanted: int, what: str) -> int:
    """``wanted`` where it is free, else ``PortBusy``."""
    if not _is_free(kind, host, wanted):
        raise PortBusy(f"port {wanted} ({what}) is busy; end the program that holds it, or choose another one")
    return wanted


def preferred(kind: Kind, host: str, wanted: int, spare: Iterator[int]) -> int:
    """``wanted`` where it is free, else the next of the ``spare`` ones; 0 wants any."""
    return wanted if wanted and _is_free(kind, host, wanted) else next(spare)


def free(kind: Kind | tuple[Kind, ...], host: str, count: int) -> list[int]:
    """``count`` different ``QUIET`` ports, free at this moment; held all at once, so none is given twice.

    Each is free for every ``kind``.  Drawn by chance, so that who asks at the same moment is given others.  Raises
    ``OSError`` where ``host`` is no address of this machine, or too few are free.
    """
    kinds = (kind,) if isinstance(kind, str) else kind
    check(kinds[0], host)
    draw = random.SystemRandom()
    found: list[int] = []
    with ExitStack() as stack:
        for port in draw.sample(QUIET, len(QUIET)):
            if len(found) == count:
                break
            try:
                for each in kinds:
                    stack.enter_context(_bound(each, host, port))
            except OSError:
                continue
            found.append(port)
    if len(found) < count:
        raise OSError(errno.EADDRINUSE, f"fewer than {count} ports are free")
    return found


def check(kind: Kind, host: str) -> None:
    """Raises ``OSError`` where ``host`` is no address of this machine."""
    _bound(kind, host, 0).close()


def _is_free(kind: Kind, host: str, port: int) -> bool:
    try:
        _bound(kind, host, port).close()
    except OSError:
        return False
    return True


def _bound(kind: Kind, host: str, port: int) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_STREAM if kind == "tcp" else socket.SOCK_DGRAM)
    try:
        if kind == "tcp":
            # As Twisted's own listening ports do: a port in TIME_WAIT is free.
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.bind((host, port))
        if kind == "tcp":
            opened.listen(1)
    except OSError:
        opened.close()
        raise
    return opened
